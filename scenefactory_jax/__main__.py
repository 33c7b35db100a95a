"""Command line -> hydra -> one function of `run/`.

    python -m scenefactory_jax train experiment=demo scenes.count=16
    python -m scenefactory_jax train -m weather=dry,mixed seed=0,1,2
"""

import importlib
import sys

import hydra

from scenefactory_jax.build import ConfigError
from scenefactory_jax.run import config as configs

USAGE = f"""usage: python -m scenefactory_jax COMMAND [key=value ...] [-m] [--help] [--cfg job]

commands: {", ".join(configs.COMMANDS)}
  train     train a policy            experiment=demo|quick|published|smoke scenes=womd scenes.path=FOLDER ...
  evaluate  judge a trained run       run=RUN_DIR scenes.path=FOLDER invincible=true|false|both
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
    if command not in configs.COMMANDS:
        raise SystemExit(f"error: unknown command {command!r}; valid: {', '.join(configs.COMMANDS)}")
    try:
        if not any(flag in overrides for flag in ("-m", "--multirun", "--help", "-h")):
            configs.load(command, *configs.as_overrides(overrides))  # a wrong key is explained here, with the valid ones
        sys.argv = [f"{sys.argv[0]} {command}", *map(configs.quoted, overrides)]
        hydra.main(version_base="1.3", config_path=str(configs.folder()), config_name=command)(_job(command))()
    except (ConfigError, FileNotFoundError, NotADirectoryError, PermissionError) as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def _job(command: str):
    """What hydra calls with each job's config."""

    def job(config) -> None:
        module = importlib.import_module(f"scenefactory_jax.run.{command}")
        try:
            getattr(module, command)(configs.plain(config))
        except ValueError as error:  # ConfigError and SceneError; a bug's own ValueError keeps its traceback
            if type(error) is ValueError:
                raise
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        except (FileNotFoundError, NotADirectoryError, PermissionError) as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(2) from None
        except Exception as error:
            if (told := _trouble(error, config)) is None:
                raise
            print(f"error: {told}", file=sys.stderr)
            raise SystemExit(2) from None

    return job


def _trouble(error: Exception, config) -> str | None:
    """What the machine or a library lacks, in one line; imported when there is trouble."""
    from scenefactory_jax.run import trouble

    return trouble.explain(error, configs.plain(config))


if __name__ == "__main__":
    main()
