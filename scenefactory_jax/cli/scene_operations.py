"""The operations of `scenes` on banks: open them, do what `scenes/operations.py` does, print the account, write the result."""

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
from rich.progress import Progress

from scenefactory_jax.core import markdown
from scenefactory_jax.core.instantiate import ConfigError, instantiate
from scenefactory_jax.core.raw_scene import RawScene, SceneError
from scenefactory_jax.core.safe_names import escape_for_terminal
from scenefactory_jax.data.bank import bank_reader as banks
from scenefactory_jax.data.bank.bank_reader import Bank
from scenefactory_jax.data.curation import duplicates, operations
from scenefactory_jax.data.curation.features import COLUMNS, EVERY_BANK
from scenefactory_jax.data.export import gpudrive, scenarionet
from scenefactory_jax.data.loading import scene_source

SHOWN = 10  # groups of duplicates, and values of a text, that are printed


def info(config: Mapping[str, Any]) -> dict[str, Any]:
    """Print what the scenes hold: of every column its range, mean and sum, and what it means; as JSON with `info.json=true`."""
    found = operations.statistics(_opened(config)[1], by=config["info"]["by"])
    if config["info"]["json"]:
        print(json.dumps(found, indent=1), flush=True)
        return found
    for value, summary in found.items():
        title = "" if config["info"]["by"] is None else escape_for_terminal(f"{config['info']['by']} = {value}: ")
        print(f"{title}{summary['scenes']} scenes\n{_table(summary)}")
        for name, counts in summary["texts"].items():
            more = f", and {len(counts) - SHOWN} more" if len(counts) > SHOWN else ""
            shown = ", ".join(f"{text} in {number}" for text, number in list(counts.items())[:SHOWN])
            print(escape_for_terminal(f"{name}: {shown}{more}"), flush=True)
    return found


def filter(config: Mapping[str, Any]) -> Bank:
    """The scenes that meet the condition `filter`."""
    if config["filter"] is None:
        raise ConfigError("filter: null; give a condition such as filter='vehicles >= 8 and lights > 0'; op=info lists the columns")
    return _written(config, operations.filter(*_opened(config), config["filter"]))


def sample(config: Mapping[str, Any]) -> Bank:
    """Some scenes at random."""
    return _written(config, operations.sample(*_opened(config), **config["sample"], seed=config["seed"]))


def split(config: Mapping[str, Any]) -> dict[str, Bank]:
    """Parts; each becomes a bank in the folder `out`."""
    if config["split"]["shares"] is None:
        raise ConfigError("split.shares: null; give the parts' shares, such as 'split.shares={train: 0.8, test: 0.2}'")
    if config["out"] is not None and banks.is_bank(config["out"]):
        raise ConfigError(f"out: {config['out']} is a bank; give another folder, in which every part becomes one")
    parts = operations.split(*_opened(config), **config["split"], seed=config["seed"])
    account = parts.account
    rows = [[name, part["scenes"], f"{part['share']:.1%}", account["leaks"][name]] for name, part in account["parts"].items()]
    print(markdown.format_table(["part", "scenes", "share", "show streets of another part"], rows))
    sizes = ", ".join(f"{number} of {size}" for size, number in account["groups_by_size"].items())
    print(f"{account['scenes']} scenes on {account['groups']} streets of their own; groups by number of scenes: {sizes}", flush=True)
    if config["out"] is None:
        return parts.banks
    return {
        name: _saved(one, Path(config["out"]) / name, config, account | {"op": "split", "part": name}) for name, one in parts.banks.items()
    }


def merge(config: Mapping[str, Any]) -> Bank:
    """`scenes.path` and `merge.banks` as one bank."""
    numbers = config["merge"]
    paths = [path for path in (config["scenes"]["path"], *numbers["banks"]) if path is not None]
    return _written(config, operations.merge([_open(path) for path in paths], duplicates=numbers["duplicates"]))


def dedupe(config: Mapping[str, Any]) -> Bank:
    """One scene of every recording."""
    made = duplicates.dedupe(*_opened(config), **config["dedupe"])
    for group in made.account["groups"][:SHOWN]:
        print(escape_for_terminal(f"one recording: {', '.join(group)}"))
    if (more := len(made.account["groups"]) - SHOWN) > 0:
        print(f"... and {more} groups more")
    return _written(config, made)


def verify(config: Mapping[str, Any]) -> Bank:
    """Read every byte of the bank against its checksums.

    Raises:
        SceneError: files that are not what was written, by name.
    """
    path = _path(config)
    banks.verify(path)
    bank = _open(path)
    print(f"{path}: {len(bank)} scenes in {len(bank.shards)} files, all as they were written", flush=True)
    return bank


def export(config: Mapping[str, Any]) -> int:
    """Write the bank's scenes, as the checks repair them, to the folder `out` in another simulator's format; return how many.

    A scene that cannot be written is listed, and the rest goes on.

    Raises:
        ConfigError: no folder, or a format that cannot be written.
        SceneError: a file of the bank that is damaged, or a place that cannot be written to.
    """
    name, out = config["export"]["format"], config["out"]
    if name not in EXPORTS:
        raise ConfigError(f"export.format: {name!r}; valid: {', '.join(EXPORTS)}")
    if out is None:
        raise ConfigError("out: null; give a folder for the files")
    bank, check = _open(_path(config)), scene_source.make_packing(config["scenes"])["check"]
    refused: list[str] = []
    repaired: Counter[str] = Counter()
    with Progress(disable=not config["progress"], transient=True) as bar:
        whole = bar.track(banks.read_raws(bank, range(len(bank))), total=len(bank), description="export")
        written = EXPORTS[name](_checked(whole, check, refused, repaired), Path(out), refused)
    lines = [f"not written: {reason}" for reason in refused[:SHOWN]]
    lines += [f"... and {len(refused) - SHOWN} more"] if len(refused) > SHOWN else []
    lines += [f"in {number} scenes: {repair}" for repair, number in repaired.items()]
    lines.append(f"{out}: {written} of {len(bank)} scenes in the format of {name}")
    print("\n".join(map(escape_for_terminal, lines)), flush=True)
    return written


def _checked(scenes: Iterable[RawScene], check: Callable[..., Any], refused: list[str], repaired: Counter[str]) -> Iterator[RawScene]:
    """Scenes as the checks repair them, such as sizes that are no numbers; those that they refuse are listed instead."""
    for raw in scenes:
        try:
            whole, lines = check(raw)
        except SceneError as error:
            refused.append(f"{raw.name}: {error}")
            continue
        repaired.update(line.split(":")[0] for line in lines)
        yield whole


EXPORTS: dict[str, Callable[[Iterable[RawScene], Path, list[str]], int]] = {
    "gpudrive": gpudrive.write_all,
    "scenarionet": scenarionet.write_all,
}


def _path(config: Mapping[str, Any]) -> str:
    """Where the bank is."""
    if config["scenes"]["path"] is None:
        raise ConfigError(f"scenes.path: null; op={config['op']} needs a bank: make one with `convert source=FILES out=BANK`")
    return config["scenes"]["path"]


def _open(path: str) -> Bank:
    """A bank, and a word where it is not whole: beside the account, which may be JSON."""
    bank = banks.open(path)
    if bank.unfinished:
        print(f"bank {path}{bank.unfinished}", file=sys.stderr, flush=True)
    return bank


def _opened(config: Mapping[str, Any]) -> tuple[Bank, pa.Table]:
    """The bank at `scenes.path`, and its metadata with every feature."""
    bank = _open(_path(config))
    features = instantiate(config["features"], builtins="scenefactory_jax.data.curation.features", where="features")
    quiet = not config["progress"] or not len(operations.find_missing_columns(bank))
    with Progress(disable=quiet, transient=True) as bar:
        task = bar.add_task("features", total=None)
        table = operations.describe_scenes(bank, features, on_scene=lambda done, total: bar.update(task, completed=done, total=total))
    return bank, table


def _written(config: Mapping[str, Any], made: operations.BankResult) -> Bank:
    """Print a result's account, and write it where `out` says so."""
    kept, scenes = made.account["kept"], made.account["scenes"]
    print(f"{config['op']}: {kept} of {scenes} scenes" + ("" if config["out"] else "; out=BANK writes them"), flush=True)
    if config["out"] is None:
        return made.bank
    return _saved(made.bank, Path(config["out"]), config, made.account | {"op": config["op"]})


def _saved(bank: Bank, path: Path, config: Mapping[str, Any], account: Mapping[str, Any]) -> Bank:
    """Write a bank with how it came to be."""
    saved = banks.save(bank, path, copy=config["copy"], settings={"made_by": dict(account), "of": dict(bank.settings)})
    print(f"{path}: {len(saved)} scenes{'' if config['copy'] else ', as a view of other banks'}", flush=True)
    return saved


def _table(summary: Mapping[str, Any]) -> str:
    """Statistics as a table, with what the columns mean."""
    meaning = {**EVERY_BANK, **COLUMNS}
    rows = []
    for name, found in summary["numbers"].items():
        cells = [f"{found[key]:.5g}" if key in found else "" for key in ("min", "median", "mean", "max", "sum")]
        rows.append([name, *cells, found["missing"] or "", meaning.get(name, "")])
    return markdown.format_table(["column", "least", "median", "mean", "most", "sum", "missing", "meaning"], rows)
