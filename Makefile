# Every target sets itself up: all it needs is Python 3.11 or newer (another one: make PYTHON=python3.12 test).
PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.installed
DEMO := data/demo
OUT := out/demo

.PHONY: demo test quick lint bench fuzz clean

demo: $(STAMP)
	$(BIN)/mrtm run $(DEMO)/team.yaml --out $(OUT)
	$(BIN)/mrtm evaluate $(OUT) --session $(DEMO)/team.yaml

test: $(STAMP)
	$(BIN)/python -m pytest -n auto

quick: $(STAMP)
	$(BIN)/python -m pytest -n auto -m "not slow"

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(STAMP)
	$(BIN)/python -m tools.benchmark

# 100000 bad inputs for every reader, with a seed of your own: make fuzz SEED=7
SEED ?= 0
fuzz: $(STAMP)
	$(BIN)/python -m tools.fuzz --count 100000 --seed $(SEED)

clean:
	rm -rf out build .mypy_cache .ruff_cache .pytest_cache .hypothesis *.egg-info
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	touch $@
