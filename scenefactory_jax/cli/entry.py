"""Runs a command from its arguments: composes the config, calls one function, and ends user errors as one line with exit code 2.

entry.run("validate", validate)    # in a program: the arguments are those of the process
"""

import os
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

import hydra

from scenefactory_jax.cli import hydra_config as configs
from scenefactory_jax.core.instantiate import ConfigError
from scenefactory_jax.core.safe_names import escape_for_terminal

Function = Callable[[dict[str, Any]], Any]


def run(name: str, function: Function, arguments: Sequence[str] | None = None, *, about: str = "") -> None:
    """Runs one command.

    Args:
        name: of the config in `conf/command/`.
        function: called with the composed config, in a sweep once a job.
        arguments: after the command; None: those of the process.
        about: first line of `--help`.
    """
    try:
        _run(name, function, sys.argv[1:] if arguments is None else arguments, about)
    except KeyboardInterrupt as stopped:  # a training that another signal ended carries that signal
        raise SystemExit(128 + (stopped.args[0] if stopped.args else signal.SIGINT)) from None  # as a shell counts it
    except BrokenPipeError:  # `--help | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that Python's last flush finds a file
        raise SystemExit(141) from None
    except (ConfigError, OSError) as error:
        end(error)


def end(error: Exception | str) -> NoReturn:
    """Prints one line to stderr and exits with code 2."""
    text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
    print("\n".join(map(escape_for_terminal, f"error: {text}".split("\n"))), file=sys.stderr)
    raise SystemExit(2) from None


def _run(name: str, function: Function, arguments: Sequence[str], about: str) -> None:
    flags = configs.parse_flags(arguments)
    if flags.help:
        print(_format_help(name, configs.as_overrides(flags), about), flush=True)
        return
    if flags.resolve and not flags.cfg:
        raise ConfigError("--resolve: expected --cfg job beside it")
    overrides, varied, config = configs.as_overrides(flags), set[str](), None
    if flags.cfg:
        configs.load_with_choices(name, *overrides)
    elif flags.multirun:
        varied = _check_sweep(name, overrides)
    elif not (flags.hydra_help or flags.shell_completion or flags.info or flags.experimental_rerun):
        config = configs.load_config(name, *overrides)  # before Hydra does, for better messages
    sys.argv = [f"{sys.argv[0]} {name}", *map(configs.quote_override, arguments)]
    job = _make_job(name, function, varied)
    if config is not None and flags.config_name is None and not any(word.startswith("hydra") for word in (*overrides, *flags.overrides)):
        return job(config)  # nothing of Hydra's own is asked for, which would compose the same again
    folder, primary = str(configs.find_conf() / "command"), flags.config_name or name
    hydra.main(version_base="1.3", config_path=folder, config_name=primary)(lambda composed: job(configs.to_dict(composed)))()


def _format_help(name: str, overrides: Sequence[str], about: str) -> str:
    """Formats the purpose of a command and its config with the comments of its files."""
    from scenefactory_jax.cli import annotated_config

    chosen = ["study=navigation"] if name == "study" and not any(word.startswith("study=") for word in overrides) else []
    last = "KEY=VALUE sets any of these keys; --cfg job shows the composed config, --hydra-help the flags of Hydra."
    return f"{name}: {about}\n\n{annotated_config.annotate(name, *chosen, *overrides)}\n\n{last}"


def _check_sweep(name: str, overrides: Sequence[str]) -> set[str]:
    """Checks the keys of a sweep before Hydra does, and that no two of its jobs evaluate into one folder; returns the keys that vary."""
    first, varied = configs.sweep(overrides)
    out = next((word for word in overrides if word.startswith("out=")), "")
    separate = "${" in out or "out" in varied or (not out and varied <= {"run"})
    if name == "evaluate" and varied and not separate:
        raise ConfigError("out: expected a folder for each job of this sweep: 'out=${run}/evaluation-${hydra:job.num}'")
    if not any("${hydra:" in word for word in overrides):  # known only within a job
        configs.load_config(name, *first)
    return varied


def _make_job(name: str, function: Function, varied: set[str]) -> Callable[[dict[str, Any]], None]:
    """Returns the function that runs the command with the config of a job."""

    def job(settings: dict[str, Any]) -> None:
        try:
            if name == "train" and varied and settings["out"] is None:
                from scenefactory_jax.learning import run_folder

                settings["out"] = str(run_folder.make_folder_name(settings["name"], configs.format_changes(varied)))
            function(settings)
        except BrokenPipeError:
            raise
        except (ValueError, OSError) as error:  # ConfigError and SceneError among them
            if type(error) is ValueError:  # a bug keeps its traceback
                raise
            end(error)
        except Exception as error:
            if (line := _explain(error, settings)) is None:
                raise
            end(line)

    return job


def _explain(error: Exception, config: Mapping[str, Any]) -> str | None:
    """Explains an error of the machine or of a library in one line."""
    from scenefactory_jax.cli import error_messages

    return error_messages.explain_error(error, config)
