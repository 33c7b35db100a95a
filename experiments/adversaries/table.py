"""One table of the attacks on several planners: `python -m experiments.adversaries.table FOLDER...` with folders that `attack` wrote.

Prints the shares, a column for each ego, and the commands that made them.
"""

import sys
from collections.abc import Mapping
from pathlib import Path

from scenefactory_jax.core import result_file
from scenefactory_jax.visualization.report import attack_report


def format_table(folders: Mapping[str, Path]) -> str:
    """Formats the table of reports, name -> folder, and a line with command and device of each."""
    results = {name: result_file.read(folder / attack_report.RESULT) for name, folder in folders.items()}
    table = attack_report.format_summary({name: result["summary"] for name, result in results.items()})
    return "\n".join([table, "", *(f"- {name}: `{result['command']}` on {result['device']}" for name, result in results.items())])


def main() -> None:
    """Prints the table of the folders that the arguments name."""
    if len(sys.argv) < 2:
        raise SystemExit("usage: python -m experiments.adversaries.table FOLDER...")
    print(format_table({folder.name.removesuffix("-report").removesuffix(".bank"): folder for folder in map(Path, sys.argv[1:])}))


if __name__ == "__main__":
    main()
