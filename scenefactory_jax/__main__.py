"""Command line: one function of `cli/` for each command.

python -m scenefactory_jax train experiment=demo scenes.count=16
python -m scenefactory_jax train -m weather=dry,mixed seed=0,1,2
"""

import importlib
import sys
from typing import Any

from scenefactory_jax.cli import entry
from scenefactory_jax.core.instantiate import ConfigError

COMMANDS = {  # name -> purpose, and the keys to begin with
    "train": ("Train a policy.", "experiment=demo|quick|paper|smoke scenes=womd scenes.path=FOLDER"),
    "record": ("Record an expert's samples for imitation.", "out=FOLDER spawning=logged scenes.path=FOLDER"),
    "evaluate": ("Evaluate a policy on held-out scenes.", "run=RUN scenes.path=FOLDER protocol=recorded|paper|strict|trained"),
    "attack": ("Make adversarial scenes.", "planner=idm_route scenes.path=BANK out=BANK"),
    "compare": ("Compare training runs.", "runs='[runs/A-*,runs/B]' out=FOLDER"),
    "export": ("Export a policy to one small folder.", "run=RUN out=FOLDER"),
    "convert": ("Convert scene files to a bank.", "source=FILE_OR_FOLDER out=BANK"),
    "scenes": ("Check, select, split and export scenes.", "op=info|select|split|... scenes.path=BANK out=BANK"),
    "view": ("Watch episodes, or drive a car.", "run=RUN scenes.path=FOLDER out=view.html|.gif|.mp4|.png|.rrd|.xml window=true"),
    "benchmark": ("Measure steps per second.", "experiment=paper suite=throughput scenes.path=FOLDER out=FOLDER"),
    "study": ("Train, evaluate and report an experiment.", "study=navigation|transfer|... train_scenes=BANK test_scenes=BANK"),
    "search_friction": ("Find the least water or ice that makes a policy fail.", "run=RUN|planner=pdm_closed scenes.path=BANK out=FOLDER"),
    "sysid": ("Fit the car to a reference model.", "sysid=reduced|full workers=N resume=true out=FOLDER"),
    "physics": ("Print tables of the friction model.", "weather=dry|wet|... out=FOLDER"),
}

USAGE = "\n".join(
    [
        "usage: python -m scenefactory_jax COMMAND [key=value ...] [-m] [--help] [--cfg job]",
        "",
        *(f"  {name:<16}{purpose}\n{'':<18}{keys}" for name, (purpose, keys) in COMMANDS.items()),
        "",
        "COMMAND --help shows all keys of a command with their defaults; COMMAND --cfg job shows the config of your command line.",
        "RUN is a folder that `train` or `export` wrote, or the name of a bundled policy (town).",
    ]
)


def main() -> None:
    """Runs the command that the first argument names."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        raise SystemExit(0 if arguments else 2)
    command, *rest = arguments
    if command not in COMMANDS:
        entry.end(ConfigError(f"command: expected one of {', '.join(COMMANDS)}, got {command!r}"))

    def function(config: dict[str, Any]) -> Any:
        return getattr(importlib.import_module(f"scenefactory_jax.cli.{command}"), command)(config)

    entry.run(command, function, rest, about=" ".join(COMMANDS[command]))


if __name__ == "__main__":
    main()
