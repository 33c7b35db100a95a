"""Command line -> hydra -> one function of `run/`.

    python -m scenefactory_jax train experiment=demo scenes.count=16
    python -m scenefactory_jax train -m weather=dry,mixed seed=0,1,2
"""

import importlib
import json
import re
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

import hydra

from scenefactory_jax.build import ConfigError
from scenefactory_jax.run import config as configs
from scenefactory_jax.scenes.names import for_terminal

USAGE = f"""usage: python -m scenefactory_jax COMMAND [key=value ...] [-m] [--help] [--cfg job]

commands: {", ".join(configs.COMMANDS)}
  train     train a policy            experiment=demo|quick|published|smoke scenes=womd scenes.path=FOLDER ...
  evaluate  judge a trained run       run=RUN_DIR scenes.path=FOLDER protocol=recorded|paper|strict|trained
  compare   several runs              runs='[runs/A-*,runs/B]' out=FOLDER
  convert   scenes -> a bank          source=FILE_OR_FOLDER out=BANK
  scenes    look at, choose, divide   op=info|filter|split|merge|dedupe|... scenes.path=BANK out=BANK
  render    scenes as MJCF and images scenes.path=FOLDER_OR_BANK out=FOLDER
  replay    a page to watch and ask   run=RUN_DIR scenes.path=FOLDER_OR_BANK worlds=4 seconds=20 out=replay.html|.gif|.mp4|.png|.rrd
  drive     a car, by keyboard        run=RUN_DIR scenes.path=FOLDER_OR_BANK weather=dry|ice|... dynamics=mjx_car|bicycle
  export    a policy to hand on        run=RUN_DIR out=FOLDER
  bench     measure speed             experiment=published scenes.path=FOLDER_OR_BANK suite=throughput out=FOLDER
  validate  hold the physics to tests validation=reduced|full parts='[drives,laws]' resume=true workers=N out=FOLDER
  study     an experiment, whole      study=navigation|transfer|friction|... train_scenes=BANK test_scenes=BANK
  weather   what friction there is    weather=dry|wet|... out=FOLDER
  sysid     fit the car to a teacher  sysid=reduced|full resume=true workers=N out=FOLDER

`COMMAND --help` shows the config of a command, `COMMAND --cfg job` the one that your overrides give."""


def main() -> None:
    """Run one command; what the user can mend ends as one line on stderr and exit code 2, never as a traceback."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        raise SystemExit(0 if arguments else 2)
    command, overrides = arguments[0], arguments[1:]
    try:
        if command not in configs.COMMANDS:
            raise ConfigError(f"unknown command {command!r}; valid: {', '.join(configs.COMMANDS)}")
        if any(flag in overrides for flag in ("--help", "-h")):
            overrides = [*overrides, *_help(command, overrides)]
        else:
            _check(command, overrides)
        sys.argv = [f"{sys.argv[0]} {command}", *map(configs.quoted, overrides)]
        hydra.main(version_base="1.3", config_path=str(configs.folder()), config_name=command)(_job(command))()
    except KeyboardInterrupt as stopped:  # a training that another signal ended says which
        raise SystemExit(128 + (stopped.args[0] if stopped.args else signal.SIGINT)) from None  # as a shell counts it
    except (ConfigError, OSError) as error:
        _end(error)


def _help(command: str, overrides: Sequence[str]) -> list[str]:
    """Hydra's own help shows the config, given these: what the command is for comes first, and nothing may be missing."""
    purpose, keys = re.findall(rf"^  {command} +(.*?) +(\S+=.*)$", USAGE, re.MULTILINE)[0]
    chosen = ["study=navigation"] if command == "study" and not any(word.startswith("study=") for word in overrides) else []
    return [f"hydra.help.header={json.dumps(f'{command}: {purpose}; {keys}')}", *chosen]


def _check(command: str, overrides: Sequence[str]) -> None:
    """A wrong key is explained here, with the valid ones; and no two jobs of a sweep may judge into one folder."""
    settings = configs.as_overrides(overrides)
    if not any(flag in overrides for flag in ("-m", "--multirun")):
        configs.load(command, *settings)
        return
    first, varied = configs.sweep(settings)
    out = next((word for word in settings if word.startswith("out=")), "")
    apart = "${" in out or "out" in varied or (not out and varied <= {"run"})
    if command == "evaluate" and varied and not apart:
        raise ConfigError("out: the jobs of this sweep would write to one folder; give each its own: 'out=${run}/judged-${hydra:job.num}'")
    if not any("${hydra:" in word for word in settings):  # it is known within a job alone
        configs.load(command, *first)


def _end(error: Exception | str) -> NoReturn:
    """One line on stderr, and exit code 2."""
    text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
    print("\n".join(map(for_terminal, f"error: {text}".split("\n"))), file=sys.stderr)
    raise SystemExit(2) from None


def _job(command: str):
    """What hydra calls with each job's config."""

    def job(config) -> None:
        module = importlib.import_module(f"scenefactory_jax.run.{command}")
        try:
            getattr(module, command)(configs.plain(config))
        except (ValueError, OSError) as error:  # ConfigError and SceneError among them; a bug's own ValueError keeps its traceback
            if type(error) is ValueError:
                raise
            _end(error)
        except Exception as error:
            if (told := _trouble(error, config)) is None:
                raise
            _end(told)

    return job


def _trouble(error: Exception, config) -> str | None:
    """What the machine or a library lacks, in one line; imported when there is trouble."""
    from scenefactory_jax.run import trouble

    return trouble.explain(error, configs.plain(config))


if __name__ == "__main__":
    main()
