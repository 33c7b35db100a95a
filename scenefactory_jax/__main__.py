"""Command line -> hydra -> one function of `run/`.

    python -m scenefactory_jax train experiment=demo scenes.count=16
    python -m scenefactory_jax train -m weather=dry,mixed seed=0,1,2
"""

import importlib
import os
import re
import signal
import sys
from collections.abc import Sequence
from typing import NoReturn

import hydra

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.safe_names import escape_for_terminal

USAGE = f"""usage: python -m scenefactory_jax COMMAND [key=value ...] [-m] [--help] [--cfg job]

commands: {", ".join(configs.COMMANDS)}
  train     train a policy            experiment=demo|quick|published|smoke scenes=womd scenes.path=FOLDER ...
  evaluate  judge a trained run       run=RUN_DIR scenes.path=FOLDER protocol=recorded|paper|strict|trained
  compare   several runs              runs='[runs/A-*,runs/B]' out=FOLDER
  convert   scenes -> a bank          source=FILE_OR_FOLDER out=BANK
  scenes    look at, choose, divide   op=info|filter|split|merge|dedupe|... scenes.path=BANK out=BANK
  view      watch or drive            run=RUN_DIR scenes.path=FOLDER_OR_BANK worlds=4 out=view.html|.gif|.mp4|.png|.rrd|.xml window=true
  export    a policy to hand on        run=RUN_DIR out=FOLDER
  bench     measure speed             experiment=paper scenes.path=FOLDER_OR_BANK suite=throughput out=FOLDER
  validate  hold the physics to tests validation=reduced|full parts='[drives,laws]' resume=true workers=N out=FOLDER
  study     an experiment, whole      study=navigation|transfer|friction|... train_scenes=BANK test_scenes=BANK
  weather   what friction there is    weather=dry|wet|... out=FOLDER
  sysid     fit the car to a teacher  sysid=reduced|full resume=true workers=N out=FOLDER

`COMMAND --help` shows the config of a command, `COMMAND --cfg job` the one that your overrides give."""


MODULES = {
    "train": "scenefactory_jax.learning.training_loop",
    "evaluate": "scenefactory_jax.evaluation.protocols",
    "bench": "scenefactory_jax.cli.benchmark",
    "weather": "scenefactory_jax.cli.physics",
    "validate": "experiments.validation.run",
}


def main() -> None:
    """Run one command; what the user can mend ends as one line on stderr and exit code 2, never as a traceback."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        print(USAGE)
        raise SystemExit(0 if arguments else 2)
    try:
        _run(arguments[0], arguments[1:])
    except KeyboardInterrupt as stopped:  # a training that another signal ended says which
        raise SystemExit(128 + (stopped.args[0] if stopped.args else signal.SIGINT)) from None  # as a shell counts it
    except BrokenPipeError:  # `--help | head`: the reader has what it wanted
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that Python's last flush finds a file
        raise SystemExit(141) from None
    except (ConfigError, OSError) as error:
        _end(error)


def _run(command: str, arguments: Sequence[str]) -> None:
    if command not in configs.COMMANDS:
        raise ConfigError(f"unknown command {command!r}; valid: {', '.join(configs.COMMANDS)}")
    flags = configs.parse_flags(arguments)
    if flags.help:
        print(_help(command, configs.as_overrides(flags)), flush=True)
        return
    if flags.resolve and not flags.cfg:
        raise ConfigError("--resolve: goes with --cfg job")
    varied: set[str] = set()
    if flags.cfg:
        configs.load_with_choices(command, *configs.as_overrides(flags))
    elif not (flags.hydra_help or flags.shell_completion or flags.info or flags.experimental_rerun):
        varied = _check(command, configs.as_overrides(flags), sweeps=flags.multirun)
    sys.argv = [f"{sys.argv[0]} {command}", *map(configs.quote_override, arguments)]
    name = flags.config_name or configs.find_config_name(command)
    hydra.main(version_base="1.3", config_path=str(configs.find_conf()), config_name=name)(_job(command, varied))()


def _help(command: str, settings: Sequence[str]) -> str:
    """What a command is for, and its config with the comments of its files."""
    from scenefactory_jax.cli import annotated_config

    purpose, keys = re.findall(rf"^  {command} +(.*?) +(\S+=.*)$", USAGE, re.MULTILINE)[0]
    chosen = ["study=navigation"] if command == "study" and not any(word.startswith("study=") for word in settings) else []
    last = "KEY=VALUE on the command line sets any of these; --cfg job shows what a command line gives, --hydra-help Hydra's own flags."
    return f"{command}: {purpose}; {keys}\n\n{annotated_config.annotate(command, *chosen, *settings)}\n\n{last}"


def _check(command: str, settings: Sequence[str], *, sweeps: bool) -> set[str]:
    """The keys that vary in a sweep. A wrong key is explained here, with the valid ones; and no two jobs may judge into one folder."""
    if not sweeps:
        configs.load_config(command, *settings)
        return set()
    first, varied = configs.sweep(settings)
    out = next((word for word in settings if word.startswith("out=")), "")
    apart = "${" in out or "out" in varied or (not out and varied <= {"run"})
    if command == "evaluate" and varied and not apart:
        raise ConfigError("out: the jobs of this sweep would write to one folder; give each its own: 'out=${run}/judged-${hydra:job.num}'")
    if not any("${hydra:" in word for word in settings):  # it is known within a job alone
        configs.load_config(command, *first)
    return varied


def _end(error: Exception | str) -> NoReturn:
    """One line on stderr, and exit code 2."""
    text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
    print("\n".join(map(escape_for_terminal, f"error: {text}".split("\n"))), file=sys.stderr)
    raise SystemExit(2) from None


def _job(command: str, varied: set[str]):
    """What hydra calls with each job's config; `varied`: the keys in which the jobs of a sweep differ."""

    def job(config) -> None:
        module = importlib.import_module(MODULES.get(command, f"scenefactory_jax.cli.{command}"))
        try:
            settings = configs.to_dict(config)
            if command == "train" and varied and settings["out"] is None:
                settings["out"] = str(module.train_folder.fresh(settings["name"], configs.format_changes(varied)))
            getattr(module, command)(settings)
        except BrokenPipeError:
            raise
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
    from scenefactory_jax.cli import error_messages

    return error_messages.explain_error(error, configs.to_dict(config))


if __name__ == "__main__":
    main()
