"""What tests share: where the real logs are, and how property tests draw their examples.

No example has to be found in time: machines are noisy. The same code is told the same: what is drawn follows from the
test itself. To look for new examples, ``pytest --hypothesis-profile default``.
"""

import os
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("mrtm", deadline=None, derandomize=True)
settings.load_profile("mrtm")

ROOT = Path(__file__).parents[1]
PLACES = (os.environ.get("MRTM_DATA", ""), ROOT.parent / "shared" / "data", ROOT / "data" / "cache")


@pytest.fixture(scope="session")
def data() -> Path:
    """The directory of the real logs: $MRTM_DATA, ../shared/data or data/cache; without one the test is skipped."""
    for place in PLACES:
        if place and any(Path(place).glob("*.clf*")):
            return Path(place)
    pytest.skip("no real logs: set MRTM_DATA to their directory")
