"""Runs an item of docs/results.md, or all of them.

python benchmarks/reproduce.py zhu2012.table_1a    the numbers and pictures of one item
python benchmarks/reproduce.py zhu2012.document    all items, and the document: make results
"""

from __future__ import annotations

import argparse
import runpy
import sys
from pathlib import Path

from paceline.errors import UnusableInput
from paceline.exit_status import EXIT_UNUSABLE_INPUT

PAPERS = ("zhu2012", "nist1993")


def runnable_modules() -> list[str]:
    """The modules that can be run, each as FOLDER.NAME."""
    files = [file for paper in PAPERS for file in sorted((Path(__file__).parent / paper).glob("*.py"))]
    runnable = [file for file in files if '__name__ == "__main__"' in file.read_text(encoding="utf-8")]
    return [f"{file.parent.name}.{file.stem}" for file in runnable]


def main() -> int:
    parser = argparse.ArgumentParser(description="Runs an item of docs/results.md.")
    parser.add_argument("item", metavar="ITEM", choices=runnable_modules(), help="as docs/results.md names it")
    parser.add_argument("options", nargs=argparse.REMAINDER, help="those of the item; --help lists them")
    args = parser.parse_args()
    sys.argv[1:] = args.options
    try:
        runpy.run_module(args.item, run_name="__main__", alter_sys=True)
    except UnusableInput as error:
        print(f"{args.item}: {error}", file=sys.stderr)
        return EXIT_UNUSABLE_INPUT
    return 0


if __name__ == "__main__":
    sys.exit(main())
