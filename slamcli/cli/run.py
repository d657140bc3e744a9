"""`run`, one command per stage, `status` and `config`."""

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from slamcli.cli.common import complete_run, complete_target, config_option, json_option, recording_options, run_option, set_option
from slamcli.hints import hint, run_flag
from slamcli.stages import NAMES, STAGES, Stage

if TYPE_CHECKING:
    from slamcli.api import Run
    from slamcli.datasets import Dataset
    from slamcli.evaluation.map_verdict import Verdict
    from slamcli.runs.placement import Placement
    from slamcli.runs.run_directory import RunDir
    from slamcli.runs.staleness import State
    from slamcli.runs.summary import Warned
    from slamcli.slam import doubt

STAGE = click.Choice(NAMES)


@click.command("run")
@click.argument("targets", nargs=-1, metavar="[TARGET]...", shell_complete=complete_target)
@click.option(
    "-r",
    "--run",
    metavar="DIR",
    shell_complete=complete_run,
    help="The run directory, or its name under runs/; needed with several. [default: $SLAMCLI_RUN, else runs/<recording>]",
)
@click.option("--data", metavar="DIR", help="Folder of recordings. [default: $SLAMCLI_DATA, else ./data]")
@recording_options
@config_option
@set_option
@click.option("--from", "start", type=STAGE, help="Run this stage and those after it even if they are up to date.")
@click.option("--until", type=STAGE, help="Stop after this stage.")
@click.option("--force", is_flag=True, help="Run every stage even if it is up to date.")
@json_option
def run_command(
    targets: tuple[str, ...],
    run: str | None,
    data: str | None,
    config_name: str | None,
    assignments: tuple[str, ...],
    start: str | None,
    until: str | None,
    force: bool,
    as_json: bool,
    selection: dict[str, Any],
) -> None:
    """Bring a run up to date: exactly the stages that need it.

    TARGET is a recording: `demo` for a simulated room, a folder or file of any layout that `slamcli formats` lists, or a name such as
    `tum/fr1_room`, which is downloaded when it is not found. Without TARGET an existing run goes on. Prints the run directory; with
    --json also what was made and how good the map is.

    Several recordings of one place, by any cameras, make one map: each is tracked alone, and places that two of them saw join them. What
    joins nothing is kept apart. For a run of each instead: slamcli batch.

    \b
      slamcli run demo
      slamcli run tum/fr1_room -s extract.features=1500
      slamcli run path/to/recording -r runs/mine --config accurate
      slamcli run walk.mcap --start 10 --end 60
      slamcli run monday tuesday upstairs -r runs/house
    """
    from slamcli import api, console

    named = run or os.environ.get("SLAMCLI_RUN")
    if len(targets) > 1 and not named:
        raise click.UsageError(
            "several recordings make one map, whose run needs a name, such as -r runs/house; for a run of each: slamcli batch RECORDING..."
        )
    assignments = (*(f"{name}={json.dumps(value)}" for name, value in selection.items()), *assignments)
    options: dict[str, Any] = {"settings": assignments, "config": config_name, "start": start, "until": until, "force": force}
    options |= {"progress": console.progress, "tell": console.say}
    if targets:
        done = api.run(targets, path=named, data=data, look=_look, **options)
    else:
        done = api.open_run(named, restore=True).update(**options)
    _tell_done(done, as_json=as_json, is_whole=until is None)


@click.command("add")
@click.argument("run", metavar="RUN", shell_complete=complete_run)
@click.argument("targets", nargs=-1, required=True, metavar="RECORDING...", shell_complete=complete_target)
@click.option("--data", metavar="DIR", help="Where recordings lie. [default: $SLAMCLI_DATA, else ./data]")
@json_option
def add_command(run: str, targets: tuple[str, ...], data: str | None, as_json: bool) -> None:
    """Add recordings to the map of RUN: they are tracked, joined to it where both saw a place, and all maps are made anew.

    What RUN has tracked already stays as it is. The added ones count as taken later: what they show to be gone fades from the maps.

    \b
      slamcli add runs/house wednesday
    """
    from slamcli import api, console

    done = api.open_run(run, restore=True).add(*targets, data=data, progress=console.progress, tell=console.say, look=_look)
    _tell_done(done, as_json=as_json, is_whole=True)


def _tell_done(done: "Run", *, as_json: bool, is_whole: bool) -> None:
    """Tell what a run holds now, and refuse to call it a success where no frame has a pose."""
    if as_json:
        click.echo(json.dumps(_made_object(done.directory), indent=1))
    else:
        if is_whole:
            _tell_made(done.directory)
        click.echo(done.path)
    _refuse_no_pose(done.directory)


def _refuse_no_pose(rundir: "RunDir") -> None:
    """End with status 1 where no frame has a pose: the maps are there, and show nothing."""
    from slamcli.errors import SlamError

    counts = (rundir.record("loop") or {}).get("summary", {})
    if counts and counts["lost"] == counts["frames"]:
        root = rundir.info()["root"]
        raise SlamError(f"{rundir.path}: no frame has a pose, so there is no map; the warnings say why; try: slamcli inspect {root}")


def _tell_made(rundir: "RunDir") -> None:
    """Tell what a finished run made, whether a robot could use the map, and what comes next."""
    from slamcli import console
    from slamcli.runs import placement, summary

    if not (made := summary.outcome(rundir)):
        return
    console.say(made)
    where, verdict = _place_and_verdict(rundir)
    if where is not None and verdict is not None:
        for name, told in (*placement.lines(where), ("map", verdict.summary)):
            console.say(f"{name:<10}  {told}")
        for finding in verdict.findings:
            console.say(console.amber(f"{'problem' if finding.is_grave else 'note':<10}  {finding.message}"))
            console.say(console.amber(f"{'':<10}  -> {finding.remedy}"))
    console.say("next: " + "\n      ".join(_next_commands(rundir, is_usable=verdict is None or verdict.is_usable)))


def _place_and_verdict(rundir: "RunDir") -> "tuple[Placement | None, Verdict | None]":
    """Read where a run's frames lie and judge its map; nothing where its files do not tell."""
    from slamcli import console
    from slamcli.errors import SlamError
    from slamcli.evaluation import map_verdict
    from slamcli.runs import placement

    try:
        return placement.read(rundir), map_verdict.of_run(rundir)
    except SlamError as error:
        console.say(f"{'map':<10}  not judged: {error}")
        return None, None


def _made_object(rundir: "RunDir") -> dict[str, Any]:
    from slamcli.runs import summary

    where, verdict = _place_and_verdict(rundir) if rundir.record("grid2d") is not None else (None, None)
    return summary.to_dict(rundir) | {
        "frames": where.to_dict() if where is not None else None,
        "map": verdict.to_dict() if verdict is not None else None,
        "next": _next_commands(rundir, is_usable=verdict is None or verdict.is_usable),
    }


def _next_commands(rundir: "RunDir", *, is_usable: bool) -> list[str]:
    """List the commands that come next for this run, each to be pasted as it is; none for a robot where no floor is free.

    is_usable : whether a robot could use the map, by its verdict
    """
    roots = [entry["root"] for entry in rundir.recordings] or [rundir.info()["root"]]
    has_truth = any((Path(root) / "groundtruth.txt").is_file() for root in roots)
    has_floor = (rundir.record("grid2d") or {"summary": {}})["summary"].get("free", 0) > 0
    which = run_flag(rundir.path)
    return [
        *([f"slamcli eval ape {which}"] if has_truth else []),
        f"slamcli report {which}",
        *([f"slamcli export-grid map.pgm --png map.png {which}"] if has_floor else []),
        *([f"slamcli plan --start first --reachable {which}"] if has_floor and is_usable else []),
    ]


def _look(dataset: "Dataset") -> "list[doubt.Finding]":
    """Say what a look at a few frames shows, before time is spent on the recording; returns what puts its result in doubt."""
    import logging

    from slamcli import inspection

    found = inspection.quick_look(dataset)
    for finding in found:
        logging.getLogger("slamcli").warning("%s: %s", dataset.root, "; ".join(filter(None, (finding.message, finding.advice))))
    return inspection.doubts(found)


def _stage_command(stage: Stage) -> click.Command:
    @click.command(stage.name, short_help=stage.help, help=_stage_help(stage))
    @run_option
    @config_option
    @set_option
    def command(run: str | None, config_name: str | None, assignments: tuple[str, ...]) -> None:
        from slamcli import api, console
        from slamcli.runs import staleness

        done = api.open_run(run).run_stage(
            stage.name, settings=assignments, config=config_name, progress=console.progress, tell=console.say
        )
        made = ((name, state) for name, state in done.status().items() if state.state != staleness.MISSING)
        behind = [name for name, state in made if not state.is_fresh and not done.directory.is_cleaned(state)]
        if behind:
            console.say(f"not up to date now: {', '.join(behind)}; make them anew with: {hint().update(done.path)}")

    return command


def _stage_help(stage: Stage) -> str:
    needs = ", ".join("the recording" if name == "dataset" else name for name in stage.needs)
    options = ", ".join(stage.config)
    return f"{stage.help}\n\nRuns this stage alone, even when it is up to date. It reads {needs}; options: seed and those of {options}."


stage_commands = tuple(_stage_command(stage) for stage in STAGES)


@click.command("status")
@run_option
@config_option
@set_option
@json_option
@click.option("--verify", is_flag=True, help="Read every file again and compare its digest.")
def status_command(run: str | None, config_name: str | None, assignments: tuple[str, ...], as_json: bool, verify: bool) -> None:
    """Show which stages are up to date, why the others are not, and how much each warned of; with -v, of what.

    With -s or --config it shows what such a change would make stale, and changes nothing.
    """
    from slamcli import console
    from slamcli.config import toml
    from slamcli.runs.run_directory import RunDir
    from slamcli.runs.several import pipeline
    from slamcli.runs.summary import warned

    rundir = RunDir.find(run)
    judged = pipeline(rundir, toml.resolve(rundir.config(), config_name, assignments))
    states = judged.states(verify=verify)
    said = {name: warned(rundir, name) for name in states}
    if as_json:
        click.echo(json.dumps([_state_object(state, said[name]) for name, state in states.items()], indent=1))
    else:
        click.echo(_state_table(rundir, states, said))
    if console.is_verbose() and not as_json:
        for line in _warned_lines(said):
            click.echo(line)
    for note in judged.notes(states):
        click.echo(f"note: {note}", err=as_json)
    if not as_json and not console.is_verbose() and any(one.count for one in said.values()):
        console.say(f"what was warned of: slamcli status -v {run_flag(rundir.path)}")


def _state_object(state: "State", said: "Warned") -> dict[str, Any]:
    names = ("seconds", "fps", "cpu_seconds", "peak_rss_mb", "digest", "summary", "warnings")
    about = {"stage": state.stage, "state": state.state, "reason": state.reason, **{name: state.record.get(name) for name in names}}
    return about | {"warned": said.texts, "n_warned": said.count}


def _warned_lines(said: "Mapping[str, Warned]") -> list[str]:
    """Tell what each stage warned of."""
    lines = []
    for stage, warned in said.items():
        lines += [f"{stage}: {text}" for text in warned.texts]
        if left := warned.count - len(warned.texts):
            lines.append(f"{stage}: {left} more; they are in log.txt")
    return lines


def _state_table(rundir: "RunDir", states: "dict[str, State]", said: "Mapping[str, Warned]") -> str:
    from slamcli.console import table, warning_count
    from slamcli.runs.staleness import MISSING

    rows = []
    for state in states.values():
        seconds, fps = state.record.get("seconds"), state.record.get("fps")
        times = [f"{seconds:.1f} s" if seconds is not None else "", f"{fps:.1f} fps" if fps else ""]
        told, reason = state.state, state.reason
        if not state.is_fresh and rundir.is_cleaned(state):
            told, reason = (
                ("cleaned", "") if told == MISSING else ("kept", "what it was made from was cleaned away: slamcli run makes all anew")
            )
        n = said[state.stage].count
        rows.append([state.stage, told, *times, warning_count(n) if n else "", reason])
    if not any(row[4] for row in rows):
        rows = [[*row[:4], row[5]] for row in rows]
    return f"{rundir.path}: {rundir.info()['dataset']} ({rundir.info()['root']})\n" + table(rows, right=(2, 3))


@click.command("config")
@click.argument("names", nargs=-1, metavar="[SECTION|SECTION.KEY]...")
@run_option
@config_option
@set_option
@click.option("--defaults", is_flag=True, help="Show the defaults, whatever run there is.")
@click.option("--explain", is_flag=True, help="Show what each option means, its unit and bounds; finds options by any word.")
@click.option("--changed", is_flag=True, help="Show only what differs from the defaults.")
@json_option
def config_command(
    names: tuple[str, ...], run: str | None, config_name: str | None, assignments: tuple[str, ...], defaults: bool, explain: bool,
    changed: bool, as_json: bool,
) -> None:  # fmt: skip
    """Show the configuration of the run as TOML, or where there is no run yet, of a new one.

    \b
      slamcli config --changed
      slamcli config --explain track
      slamcli config --explain floor         every option about it
      slamcli config extract.features
    """
    from slamcli.config import toml
    from slamcli.config.options import Config
    from slamcli.runs.places import LATEST
    from slamcli.runs.run_directory import RunDir

    has_run = run or os.environ.get("SLAMCLI_RUN") or LATEST.exists()
    base = RunDir.find(run).config() if has_run and not defaults else Config()
    config = toml.resolve(base, config_name, assignments)
    only = toml.find_options(names) if explain else list(names)
    if changed:
        only = [name for name in toml.changed(config) if not only or name in only or name.partition(".")[0] in only]
    if as_json:
        click.echo(json.dumps(toml.to_dict(config, only if names or changed else None), indent=1))
        return
    if changed and not only:
        click.echo("# nothing differs from the defaults")
        return
    click.echo(toml.dump(config, explain=explain, only=only, with_defaults=changed), nl=False)
