"""How often `calibrate` ends above the lowest minimum: counts for each kind of problem, as a table.

    python -m tests.calibration.minima                                   # 300 problems of each kind: hours
    python -m tests.calibration.minima --problems 50 telephoto wide      # some
    python -m tests.calibration.minima --record minima.jsonl             # every problem with all its minima

The minima it is held against are those from the true cameras, OpenCV's, and SciPy's, where that is installed: for one
in ten problems, and wherever anything differs. A batch is of one image size, and of one seed, which draws it again.
"""

import argparse
import json
import warnings
from pathlib import Path

import torch

from .drawn import KINDS
from .judged import judged

COUNTED = {
    "missed": "above the best",
    "silent": "without a word",
    "matters": "by more than 0.1 deviation",
    "falsely_refused": "falsely refused",
    "lower_than_truth": "below the truth's",
}
AT_ONCE = 25
"""Problems in a batch."""


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.calibration.minima", description=__doc__)
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(KINDS)}; all if none is named")
    parser.add_argument("--problems", type=int, default=300, help="of each kind (300)")
    parser.add_argument("--seed", type=int, default=0, help="of the first batch (0)")
    parser.add_argument("--record", type=Path, help="a file of JSON lines that gets every problem")
    chosen = parser.parse_args()
    if unknown := set(chosen.kinds) - set(KINDS):
        parser.error(f"want kinds of {', '.join(KINDS)}, got {', '.join(sorted(unknown))}")
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    print(f"| kind | n | {' | '.join(COUNTED.values())} |\n|---|{'---:|' * (1 + len(COUNTED))}", flush=True)
    for kind in chosen.kinds or KINDS:
        found = []
        for batch, first in enumerate(range(0, chosen.problems, AT_ONCE)):
            found += judged(kind, chosen.seed + batch, min(AT_ONCE, chosen.problems - first))
        counts = [sum(one[name] for one in found) for name in COUNTED]
        print(f"| {kind} | {len(found)} | {' | '.join(map(str, counts))} |", flush=True)
        if chosen.record is not None:
            with chosen.record.open("a") as file:
                file.writelines(json.dumps(one) + "\n" for one in found)


if __name__ == "__main__":
    main()
