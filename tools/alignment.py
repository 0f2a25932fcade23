"""How good is alignment? ``python -m tools.alignment --seeds 4`` measures it on pairs of maps from simulated drives."""

import sys
from collections import Counter
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from tools.aligning.pairs import Case

DEFAULT_PLANS = "corridor,hall,cluttered,loop/ring,office/ring,twins"

app = typer.Typer(add_completion=False)


@app.command()
def main(
    plans: Annotated[str, typer.Option(help="Simulated buildings, NAME or NAME/ROUTE, with commas.")] = DEFAULT_PLANS,
    seeds: Annotated[int, typer.Option(min=1, help="Buildings and drives of each plan.")] = 2,
    first_seed: Annotated[int, typer.Option(min=0, help="The first seed.")] = 0,
    sigma_xy: Annotated[float, typer.Option(min=0.0, help="Standard deviation of a guess, metres.")] = 0.2,
    sigma_theta: Annotated[float, typer.Option(min=0.0, help="The same, radians.")] = 0.03,
    out: Annotated[Path, typer.Option(help="Folder for alignment.png.")] = Path("out"),
) -> None:
    """Drive two robots through each building, align all pairs of their maps, and hold the result against the truth."""
    import numpy as np

    from tools.aligning.figure import draw
    from tools.aligning.pairs import PLANS, run

    names = [name for name in plans.split(",") if name]
    for name in names:
        if name.partition("/")[0] not in PLANS:
            raise typer.BadParameter(f"--plans {name}: no such building; there is: {', '.join(PLANS)}")
    sigma = np.array([sigma_xy, sigma_xy, sigma_theta])
    cases = [
        case for name in names for seed in range(first_seed, first_seed + seeds) for case in run(name, seed, sigma)
    ]
    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(_recall(cases, names))
    console.print(_false(cases, names))
    out.mkdir(parents=True, exist_ok=True)
    title = f"Alignments of true pairs: {seeds} seeds from {first_seed}, guesses {sigma_xy} m, {sigma_theta} rad"
    draw(cases, title, out / "alignment.png")
    console.print(f"written to {out / 'alignment.png'}")


def _recall(cases: "Sequence[Case]", names: Sequence[str]) -> Table:
    import numpy as np

    table = Table(
        "plan", "pairs", "accepted", "NEES/3", "median/0.79", "error m", "90 %", "deg", "false", "ms", "refused"
    )
    for name in [*names, "all"]:
        true = [case for case in cases if case.kind == "true" and name in (case.plan, "all")]
        good = [case for case in true if case.accepted]
        if not good:
            table.add_row(name, str(len(true)), "0")
            continue
        nees = np.array([case.nees for case in good])
        errors = np.array([case.error for case in good])
        metres = np.hypot(errors[:, 0], errors[:, 1])
        table.add_row(
            name, str(len(true)), f"{len(good)} ({len(good) / len(true):.0%})", f"{nees.mean():.2f}",
            f"{np.median(nees) / 0.789:.2f}", f"{np.median(metres):.4f}", f"{np.quantile(metres, 0.9):.3f}",
            f"{np.degrees(np.median(np.abs(errors[:, 2]))):.3f}", str(sum(case.is_false for case in good)),
            f"{1e3 * np.median([case.seconds for case in true]):.0f}", _reasons(true),
        )  # fmt: skip
    return table


def _false(cases: "Sequence[Case]", names: Sequence[str]) -> Table:
    table = Table("wrong guesses", "plan", "cases", "accepted", "of them false", "refused")
    for kind, name in product(("displaced", "elsewhere"), [*names, "all"]):
        mine = [case for case in cases if case.kind == kind and name in (case.plan, "all")]
        accepted, false = sum(case.accepted for case in mine), sum(case.is_false for case in mine)
        table.add_row(kind, name, str(len(mine)), str(accepted), str(false), _reasons(mine))
    return table


def _reasons(cases: "Sequence[Case]") -> str:
    """Why cases were refused, in words without their numbers, and how many."""
    words: Counter[str] = Counter()
    for case in cases:
        if case.alignment is None:
            words["nothing met"] += 1
        elif case.alignment.refusal is not None:
            text = "".join(c for c in case.alignment.refusal.split(",")[0] if not c.isdigit() and c not in ".%")
            words[" ".join(text.split())] += 1
    return ", ".join(f"{what} {count}" for what, count in words.most_common())


if __name__ == "__main__":
    app()
