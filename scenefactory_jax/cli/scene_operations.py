"""The operations of `scenes` on banks: open them, call `data/curation/operations`, print the account, write the result."""

import functools
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from rich.progress import Progress

from scenefactory_jax.core import markdown
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.data.bank import bank_reader as banks
from scenefactory_jax.data.bank import catalogue
from scenefactory_jax.data.bank.bank_reader import Bank
from scenefactory_jax.data.curation import ego_choice, operations
from scenefactory_jax.data.curation.features import COLUMNS
from scenefactory_jax.data.curation.mirroring import mirror
from scenefactory_jax.data.curation.time_shift import shift_others
from scenefactory_jax.data.export import gpudrive, opendrive, scenarionet, womd
from scenefactory_jax.data.loading import scene_source

SHOWN = 10  # groups of duplicates, values of a text, and refusals that are printed


def info(config: Mapping[str, Any]) -> dict[str, Any]:
    """Prints statistics of every column and its meaning, or JSON (`info.json`); first reads every byte of the bank with `info.verify`."""
    if config["info"]["verify"]:
        path = _get_path(config)
        banks.verify(path)
        print(f"{path}: all files match their checksums", file=sys.stderr, flush=True)
    bank = _open(_get_path(config))
    statistics = operations.statistics(_describe(bank, config), by=config["info"]["by"])
    if config["info"]["json"]:
        print(json.dumps(statistics, indent=1), flush=True)
        return statistics
    for value, summary in statistics.items():
        title = "" if config["info"]["by"] is None else escape_for_terminal(f"{config['info']['by']} = {value}: ")
        print(f"{title}{summary['scenes']} scenes\n{_format_numbers(summary)}")
        for name, counts in summary["texts"].items():
            more = f", and {len(counts) - SHOWN} more" if len(counts) > SHOWN else ""
            shown = ", ".join(f"{text} in {number}" for text, number in list(counts.items())[:SHOWN])
            print(escape_for_terminal(f"{name}: {shown}{more}"), flush=True)
    return statistics


def _format_numbers(summary: Mapping[str, Any]) -> str:
    meaning = {**{name: text for name, (_, text) in catalogue.COLUMNS.items()}, **COLUMNS}
    rows = []
    for name, numbers in summary["numbers"].items():
        cells = [f"{numbers[key]:.5g}" if key in numbers else "" for key in ("min", "median", "mean", "max", "sum")]
        rows.append([name, *cells, numbers["missing"] or "", meaning.get(name, "")])
    return markdown.format_table(["column", "min", "median", "mean", "max", "sum", "missing", "meaning"], rows)


def select(config: Mapping[str, Any]) -> Bank:
    """Joins `scenes.path` and `select.banks`, removes duplicate recordings, filters and samples; writes the result to `out`."""
    settings = dict(config["select"])
    paths = [path for path in (config["scenes"]["path"], *settings.pop("banks")) if path is not None]
    several = [_open(path) for path in paths or [_get_path(config)]]
    bank, account = operations.select(several, lambda bank: _describe(bank, config), **settings, seed=config["seed"])
    steps = {name: step for name, step in account.items() if isinstance(step, dict)}
    for name, step in steps.items():
        print(f"{name}: {step['kept']} of {step['scenes']} scenes")
    groups = account.get("dedupe", {}).get("groups", [])
    lines = [f"one recording: {', '.join(group)}" for group in groups[:SHOWN]]
    print(*map(escape_for_terminal, _shorten(lines, len(groups))), sep="\n", end="\n" if groups else "")
    print(f"select: {account['kept']} of {account['scenes']} scenes" + ("" if config["out"] else "; out=BANK writes them"), flush=True)
    return bank if config["out"] is None else _save(bank, Path(config["out"]), config, account | {"op": "select"})


def split(config: Mapping[str, Any]) -> dict[str, Bank]:
    """Divides the scenes into parts, each a bank in the folder `out`."""
    if config["split"]["fractions"] is None:
        raise ConfigError("split.fractions: expected a fraction per part, such as 'split.fractions={train: 0.8, test: 0.2}', got null")
    if config["out"] is not None and banks.is_bank(config["out"]):
        raise ConfigError(f"out: expected a folder for the banks of the parts, got the bank {config['out']}")
    bank = _open(_get_path(config))
    parts, account = operations.split(bank, _describe(bank, config), **config["split"], seed=config["seed"])
    rows = [[name, part["scenes"], f"{part['fraction']:.1%}", account["leaks"][name]] for name, part in account["parts"].items()]
    print(markdown.format_table(["part", "scenes", "fraction", "show streets of another part"], rows))
    sizes = ", ".join(f"{number} of {size}" for size, number in account["groups_by_size"].items())
    print(f"{account['scenes']} scenes in {account['groups']} groups without common streets; groups by scenes: {sizes}", flush=True)
    if config["out"] is None:
        return parts
    return {name: _save(part, Path(config["out"]) / name, config, account | {"op": "split", "part": name}) for name, part in parts.items()}


def egos(config: Mapping[str, Any]) -> Bank:
    """Writes the bank `out` of the scenes, and of the scenes with other cars in the recording car's place; split by streets before it."""
    bank, out, settings = _open(_get_path(config)), require_out(config, "the bank"), config["egos"]
    chosen = _choose_egos(bank, **settings)
    features = instantiate(config["features"], builtins="scenefactory_jax.data.curation.features", where="features")
    account = {"op": "egos", "scenes": len(bank), **settings}
    written = banks.write(out, chosen, settings={"made_by": account, "of": dict(bank.settings)}, features=features)
    print(f"{out}: {len(written)} scenes from {len(bank)}", flush=True)
    return written


def _choose_egos(bank: Bank, *, mirrored: bool, shifts_s: Sequence[float], **settings: Any) -> Iterator[RawScene]:
    for raw in banks.read_raws(bank, range(len(bank))):
        for chosen in ego_choice.choose_egos(raw, **settings):
            for scene in (chosen, *(shift_others(chosen, seconds) for seconds in shifts_s)):
                yield from (scene, mirror(scene)) if mirrored else (scene,)


def export(config: Mapping[str, Any]) -> int:
    """Writes the bank's scenes, repaired by the checks, to the folder `out` in another simulator's format; returns their number.

    A scene that cannot be written is listed, and the rest goes on.
    """
    name, out = config["export"]["format"], require_out(config, "the files")
    write_womd = functools.partial(womd.write_all, shapes=womd.Shapes(**config["export"]["womd"]))
    others = {module.__name__.rpartition(".")[2]: module.write_all for module in (gpudrive, opendrive, scenarionet)}
    write_all = (others | {"womd": write_womd})[name]
    bank, check = _open(_get_path(config)), scene_source.make_packing(config["scenes"])["check"]
    refused: list[str] = []
    repairs: Counter[str] = Counter()
    with Progress(disable=not config["progress"], transient=True) as bar:
        raws = bar.track(banks.read_raws(bank, range(len(bank))), total=len(bank), description="export")
        written = write_all(_repair(raws, check, refused, repairs), out, refused)
    lines = _shorten([f"not written: {reason}" for reason in refused[:SHOWN]], len(refused))
    lines += [f"in {number} scenes: {repair}" for repair, number in repairs.items()]
    lines.append(f"{out}: {written} of {len(bank)} scenes in the format of {name}")
    print("\n".join(map(escape_for_terminal, lines)), flush=True)
    return written


def _repair(scenes: Iterable[RawScene], check: Callable[..., Any], refused: list[str], repairs: Counter[str]) -> Iterator[RawScene]:
    """Scenes repaired by the checks; those that the checks refuse are added to `refused`."""
    for raw in scenes:
        try:
            repaired, lines = check(raw)
        except SceneError as error:
            refused.append(f"{raw.name}: {error}")
            continue
        repairs.update(line.split(":")[0] for line in lines)
        yield repaired


# ---- parts of the operations


def require_out(config: Mapping[str, Any], content: str) -> Path:
    """The folder `out`; ConfigError without one."""
    if config["out"] is None:
        raise ConfigError(f"out: expected a folder for {content}, got null")
    return Path(config["out"])


def _shorten(lines: list[str], total: int) -> list[str]:
    return [*lines, f"... and {total - len(lines)} more"] if total > len(lines) else lines


def _get_path(config: Mapping[str, Any]) -> str:
    if config["scenes"]["path"] is None:
        raise ConfigError(f"scenes.path: null; op={config['op']} needs a bank: make one with `convert source=FILES out=BANK`")
    return config["scenes"]["path"]


def _open(path: str) -> Bank:
    """Opens a bank; a warning goes to stderr if its conversion was stopped, because stdout may be JSON."""
    bank = banks.open(path)
    if bank.unfinished:
        print(f"bank {path}{bank.unfinished}", file=sys.stderr, flush=True)
    return bank


def _describe(bank: Bank, config: Mapping[str, Any]) -> pa.Table:
    """The bank's metadata with all features."""
    features = instantiate(config["features"], builtins="scenefactory_jax.data.curation.features", where="features")
    quiet = not config["progress"] or not len(operations.find_undescribed_scenes(bank))
    with Progress(disable=quiet, transient=True) as bar:
        task = bar.add_task("features", total=None)
        return operations.describe_scenes(bank, features, on_scene=lambda done, total: bar.update(task, completed=done, total=total))


def _save(bank: Bank, path: Path, config: Mapping[str, Any], account: Mapping[str, Any]) -> Bank:
    """Writes a bank with the account of how it was made."""
    saved = banks.save(bank, path, copy=config["copy"], settings={"made_by": dict(account), "of": dict(bank.settings)})
    print(f"{path}: {len(saved)} scenes{'' if config['copy'] else ', as a view of other banks'}", flush=True)
    return saved
