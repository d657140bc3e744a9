"""slamcli vocab train | import | export | info."""

from __future__ import annotations

import json
from pathlib import Path

import click

from slamcli.cli.common import Target, json_option


@click.group()
def vocab() -> None:
    """Make, convert and look at vocabularies of visual words.

    \b
      slamcli vocab train office.npz pictures/ tum/fr1_room
      slamcli vocab import ORBvoc.txt
      slamcli match -s match.vocabulary=office.npz
    """


@vocab.command(short_help="Train a vocabulary on pictures and recordings.")
@click.argument("out", type=Target())
@click.argument("sources", nargs=-1, required=True)
@click.option("--branching", type=click.IntRange(2, 20), default=12, show_default=True, help="Children of each node.")
@click.option("--depth", type=click.IntRange(1, 10), default=4, show_default=True, help="Levels; words are at most branching^depth.")
@click.option("--features", type=click.IntRange(50, 20000), default=2000, show_default=True, help="Key points per picture.")
@click.option("--every", type=click.IntRange(1), default=10, show_default=True, help="Use every N-th frame of a recording.")
@click.option("--min-size", type=click.IntRange(1), default=4, show_default=True, help="Clusters smaller than twice this are not split.")
@click.option("--iterations", type=click.IntRange(1), default=10, show_default=True, help="Rounds of k-means at most.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    help="Of the random numbers: the same pictures and seed give the same file.",
)
@click.option("--origin", default="", help="Description of what it was trained on, kept in the file. [default: the names of the sources]")
def train(
    out: Path,
    sources: tuple[str, ...],
    branching: int,
    depth: int,
    features: int,
    every: int,
    min_size: int,
    iterations: int,
    seed: int,
    origin: str,
) -> None:
    """Train a vocabulary on SOURCES, folders of pictures or recordings, and write it to OUT (.npz)."""
    import numpy as np

    from slamcli import console
    from slamcli.errors import SlamError
    from slamcli.formats import vocabulary_file
    from slamcli.runs import vocabulary_training
    from slamcli.vision import kmeans

    if not out.absolute().parent.is_dir():
        raise SlamError(f"{out}: its folder is not there; make it first, training takes minutes")
    descriptors = vocabulary_training.descriptors(sources, features=features, every=every, progress=console.progress)
    names = ", ".join(Path(source).name for source in sources)
    made = kmeans.train(
        descriptors,
        branching=branching,
        depth=depth,
        min_size=min_size,
        iterations=iterations,
        rng=np.random.default_rng(seed),
        origin=origin or f"{len(descriptors)} pictures of {names}",
        progress=console.progress,
    )
    vocabulary_file.write(out, made)
    click.echo(f"{out}: {made.n_words} words, {out.stat().st_size / 1e6:.1f} MB, from {len(descriptors)} pictures")


@vocab.command("import", short_help="Read a DBoW2 text file, such as ORBvoc.txt.")
@click.argument("text", type=click.Path(path_type=Path, dir_okay=False))
@click.argument("out", type=Target(), required=False)
def import_(text: Path, out: Path | None) -> None:
    """Read the DBoW2 vocabulary TEXT, such as ORBvoc.txt, and write it to OUT (default: its name with .npz)."""
    from slamcli.formats import dbow2, vocabulary_file
    from slamcli.vision import vocabulary

    out = out or text.with_suffix(".npz")
    tree = dbow2.read(text)
    made = vocabulary.from_parents(tree.parent, tree.centre, tree.weight, origin=f"DBoW2 text file {text.name}", source=str(text))
    vocabulary_file.write(out, made)
    click.echo(f"{out}: {made.n_words} words, {out.stat().st_size / 1e6:.1f} MB")


@vocab.command(short_help="Write a vocabulary as a DBoW2 text file.")
@click.argument("out", type=Target())
@click.argument("vocabulary", metavar="[VOCABULARY]", type=click.Path(path_type=Path, dir_okay=False), required=False)
def export(out: Path, vocabulary: Path | None) -> None:
    """Write VOCABULARY (.npz), or the shipped one, to OUT as text, which ORB-SLAM and DBoW2 read."""
    from slamcli.formats import dbow2, vocabulary_file

    made = vocabulary_file.read(vocabulary or "")
    dbow2.write(out, dbow2.Tree(made.branching, made.depth, made.parent, made.centre[1:], made.node_weight))
    click.echo(f"{out}: {made.n_words} words, {out.stat().st_size / 1e6:.1f} MB")


@vocab.command(short_help="Show what a vocabulary holds.")
@click.argument("vocabulary", metavar="[VOCABULARY]", type=click.Path(path_type=Path, dir_okay=False), required=False)
@json_option
def info(vocabulary: Path | None, as_json: bool) -> None:
    """Show what VOCABULARY (.npz), or the shipped one, holds and what it was trained on."""
    import numpy as np

    from slamcli.formats import vocabulary_file

    path = vocabulary or vocabulary_file.SHIPPED
    found = vocabulary_file.read(path)
    facts = {
        "file": str(path),
        "bytes": path.stat().st_size,
        "words": found.n_words,
        "nodes": len(found.centre),
        "branching": found.branching,
        "depth": found.depth,
        "words_per_level": np.bincount(found.level[found.word_of_node >= 0], minlength=found.depth + 1).tolist(),
        "idf": [float(found.idf.min()), float(np.median(found.idf)), float(found.idf.max())],
        "origin": found.origin,
    }
    if as_json:
        click.echo(json.dumps(facts, indent=1))
        return
    low, middle, high = facts["idf"]
    click.echo(f"{path}: {facts['bytes'] / 1e6:.2f} MB")
    click.echo(f"  words      {found.n_words} in a tree of {len(found.centre)} nodes, {found.branching} children, {found.depth} levels")
    click.echo(f"  weights    {low:.2f} to {high:.2f}, median {middle:.2f}")
    click.echo(f"  origin     {found.origin or 'not said'}")
