"""Whether what each stage left behind still holds, and why not. Pure: records in, states and reasons out."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from slamcli.config.options import Config
from slamcli.files import digest
from slamcli.runs import source_code
from slamcli.schema import FORMAT
from slamcli.stages import Stage

UP_TO_DATE, STALE, MISSING, DAMAGED = "up to date", "stale", "missing", "damaged"


@dataclass(frozen=True)
class State:
    """What `status` says of one stage."""

    stage: str
    state: str
    reason: str = ""
    record: Mapping[str, Any] = field(default_factory=dict)  # its stage.json

    @property
    def is_fresh(self) -> bool:
        """Say whether the stage need not be run again."""
        return self.state == UP_TO_DATE


def declared(stage: Stage, config: Config) -> dict[str, Any]:
    """Return the configuration that may change a stage's result, as `stage.json` records it."""
    values: dict[str, Any] = {"seed": config.seed}
    for name in stage.config:
        section = getattr(config, name)
        values[name] = section if isinstance(section, dict) else vars(section)
    return json.loads(json.dumps(values))  # copied, and tuples become lists, as they are when read back


def named_files(stage: Stage, config: Config) -> dict[str, str]:
    """Return the options of a stage that name an input file, as ``{"section.option": path}``."""
    found = {}
    for name in stage.config:
        section = getattr(config, name)
        for spec in () if isinstance(section, dict) else fields(section):
            if spec.metadata["is_file"] and getattr(section, spec.name):
                found[f"{name}.{spec.name}"] = getattr(section, spec.name)
    return found


def key(values: Mapping[str, Any], inputs: Mapping[str, str], code: Mapping[str, str]) -> str:
    """Digest everything a stage's result depends on."""
    return digest({"format": FORMAT, "config": values, "inputs": inputs, "code": code})


def assess(
    stage: Stage,
    config: Config,
    record: Mapping[str, Any] | None,
    damage: str,
    before: Mapping[str, State],
    input_digest: Callable[[str], str | None],
    code: Mapping[str, str],
) -> State:
    """Judge one stage; cheap and certain causes come first, and the first cause found is the reason given.

    record : its `stage.json`, None where the stage has no folder; damage : what is wrong with that folder, or ""
    before : the states of the stages it needs
    input_digest : gives the present digest of "dataset" or of a file an option names; None believes the recorded one
    code : the present digests of the sources that the stage can reach
    """
    if damage:
        return State(stage.name, DAMAGED, damage)
    if record is None:
        return State(stage.name, MISSING)
    reason = (
        _changed_code(record, code)
        or _changed_config(record["config"], declared(stage, config))
        or _changed_inputs(stage, config, record["inputs"], before, input_digest)
    )
    return State(stage.name, STALE if reason else UP_TO_DATE, reason, record=record)


def _changed_code(record: Mapping[str, Any], code: Mapping[str, str]) -> str:
    if record["format"] != FORMAT:
        return f"code: format {record['format']} -> {FORMAT}"
    changes = source_code.changes(record.get("code", {}), code)
    return f"code: {changes}" if changes else ""


def _changed_config(recorded: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    before, after = ({}, {}) if recorded == now else (_flat(recorded), _flat(now))
    changes = [
        f"{name} {before.get(name, 'unset')} -> {after.get(name, 'unset')}"
        for name in sorted(before.keys() | after.keys())
        if before.get(name, "unset") != after.get(name, "unset")
    ]
    return f"config: {', '.join(changes)}" if changes else ""


def _flat(values: Mapping[str, Any]) -> dict[str, Any]:
    flat = {}
    for name, value in values.items():
        flat.update({f"{name}.{key}": item for key, item in value.items()} if isinstance(value, dict) else {name: value})
    return flat


def _changed_inputs(
    stage: Stage,
    config: Config,
    recorded: Mapping[str, str],
    before: Mapping[str, State],
    input_digest: Callable[[str], str | None],
) -> str:
    for name in stage.needs:
        if name == "dataset":
            continue
        if before[name].state == STALE and before[name].reason.endswith(f" is {DAMAGED}"):
            return before[name].reason  # what is damaged, however far back, is worth more than what follows from it
        if not before[name].is_fresh:
            return f"input: {name} is {before[name].state}"
        if before[name].record["digest"] != recorded.get(name):
            return f"input: {name} has changed"
    for name in [n for n in stage.needs if n == "dataset"] + sorted(named_files(stage, config)):
        now = input_digest(name)
        if now is not None and now != recorded.get(name):
            return f"input: {'the recording' if name == 'dataset' else name} has changed"
    return ""
