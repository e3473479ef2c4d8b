r"""``python -m benchmarks.growth`` measures how time and memory grow, and writes docs/scaling.md.

    python -m benchmarks.growth --images 50 200 500 1000 2000 --until extract_features
    python -m benchmarks.growth --images 1000 5000 --until estimate_two_view
    python -m benchmarks.growth --images 10000 --until estimate_two_view \
        --config 'adjust_bundle={final_observations: 1000}'
    python -m benchmarks.growth            # no runs, only the page from what was measured before

Measurements are kept in benchmarks/growth/measurements.json; a new one replaces that of the same scene.
"""

import argparse
import os
import tempfile
from pathlib import Path

from benchmarks import ROOT
from benchmarks.growth.measure import load, measure, save
from benchmarks.growth.report import write_report
from snakesfm.pipeline import STAGES
from snakesfm.simulate import UNTIL, SimulationOptions
from snakesfm.synthetic.surveys import SURVEYS

RECORDS = Path(__file__).with_name("measurements.json")
PAGE = ROOT / "docs" / "scaling.md"


def main() -> None:
    """Run what is asked for, one scene after the other, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--images", type=int, nargs="*", default=[], help="numbers of images")
    parser.add_argument("--survey", choices=sorted(SURVEYS), default="aerial")
    parser.add_argument(
        "--until", choices=UNTIL, default="extract_features", help="last stage that is simulated"
    )
    parser.add_argument("--last", choices=STAGES, default=None, help="stage after which the workflow stops")
    parser.add_argument(
        "--config", nargs="*", default=[], help="options of the workflow: STAGE={OPTION: VALUE}"
    )
    parser.add_argument("--tiles", type=int, default=0, help="match so many tiles only, and stop")
    parser.add_argument("--cores", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--folder", type=Path, help="where the scenes go and stay; a temporary folder otherwise"
    )
    given = parser.parse_args()
    measurements = load(RECORDS)
    with tempfile.TemporaryDirectory() as name:
        for images in given.images:
            options = SimulationOptions(images, given.survey, given.until)
            folder = (given.folder or Path(name)) / f"{given.survey}_{images}_{given.until}"
            found = measure(options, folder, given.cores, given.last or "", given.tiles, given.config)
            key = (found.survey, found.images, found.first)
            measurements = [m for m in measurements if (m.survey, m.images, m.first) != key]
            measurements = sorted([*measurements, found], key=lambda m: (m.survey, m.images, m.first))
            save(measurements, RECORDS)
    write_report(measurements, PAGE, "python -m benchmarks.growth")


if __name__ == "__main__":
    main()
