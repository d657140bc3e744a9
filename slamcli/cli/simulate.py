"""slamcli simulate: render a recording with exact truth."""

from pathlib import Path
from typing import Any

import click

from slamcli.cli.common import Target


@click.command(short_help="Render a simulated recording with exact truth.")
@click.argument("out", type=Target(is_folder=True))
@click.option("--seed", default=0, show_default=True, help="Each seed gives another room.")
@click.option("--frames", type=int, help="Images to take. [default: 360; with --speed or --turn-rate as many as the drive needs]")
@click.option("--laps", type=float, help="Rounds driven; more than 1 closes the loop. [default: 1.09; of a building 2]")
@click.option("--speed", type=float, help="Top speed [m/s]. [default: 0.6]")
@click.option("--turn-rate", type=float, help="Top turn rate [rad/s]. [default: 0.8]")
@click.option("--start", default=0.0, show_default=True, help="Share of the round at which the drive begins.")
@click.option("--backwards", is_flag=True, help="Drive the round the other way.")
@click.option("--light", default=1.0, show_default=True, help="Brightness of the colour images.")
@click.option("--take", default=0, show_default=True, help="Number of this recording of one room: noise of its own.")
@click.option("--twin", default=0, show_default=True, help="Another number is another room of the same patterns and pieces.")
@click.option("--rate", default=15.0, show_default=True, help="Images per second.")
@click.option("--rest", default=0.0, show_default=True, help="Seconds of standing still half-way.")
@click.option("--width", default=640, show_default=True, help="Of the images [px].")
@click.option("--height", default=480, show_default=True, help="Of the images [px].")
@click.option("--field-of-view", default=62.7, show_default=True, help="Horizontal field of view [degrees].")
@click.option("--camera-height", default=0.75, show_default=True, help="Above the floor [m].")
@click.option("--pitch", default=-12.0, show_default=True, help="The camera's pitch, up [degrees]; at 27 it sees no floor.")
@click.option(
    "--noise",
    type=click.Choice(["kinect", "none"]),
    default="kinect",
    show_default=True,
    help="kinect: noise as a Kinect has; none: exact images.",
)
@click.option("--depth-min", default=0.4, show_default=True, help="Nearest reading of the noisy camera [m].")
@click.option("--depth-max", default=5.0, show_default=True, help="Farthest reading of the noisy camera [m].")
@click.option("--depth-focal", type=float, help="Focal length of a depth camera of its own [px]. [default: depth is registered]")
@click.option("--depth-aside", default=0.025, show_default=True, help="Where it sits, to the right of the colour camera [m].")
@click.option("--depth-turn", default=0.5, show_default=True, help="By how much it is turned [degrees].")
@click.option("--holes", default=0.0, show_default=True, help="Share of all surface that gives no depth, as glass does.")
@click.option("--textured", default=1.0, show_default=True, help="Share of objects and walls with a picture; 0 = plain colours, shaded.")
@click.option("--dark", is_flag=True, help="No lamp: the colour images hold noise only, the depth camera has its own light.")
@click.option("--moved-object", "movable", is_flag=True, help="A parcel is taken away half-way.")
@click.option("--gone-from", default=0.5, show_default=True, help="Share of the frames after which it is gone; 0 = it never was there.")
@click.option("--door", is_flag=True, help="A door swings open while the camera looks at it.")
@click.option("--moved-chair", is_flag=True, help="A chair stands elsewhere when it is seen again.")
@click.option("--people", type=click.IntRange(0, 20), default=0, show_default=True, help="How many figures walk about in view.")
@click.option(
    "--activity",
    "activities",
    multiple=True,
    type=click.Choice(["beside", "cross", "stand", "approach", "sit", "carry"]),
    help="What the figures do, in turn; may be repeated. [default: all of these]",
)
@click.option(
    "--alias", type=click.Choice(["posters", "corridor"]), default=None, help="Places that look alike: opposite walls, equal doors."
)
@click.option("--room", type=(float, float), default=(8.0, 5.0), show_default=True, help="Sides of the room [m].")
@click.option("--empty", is_flag=True, help="Nothing stands in the room.")
@click.option("--building", is_flag=True, help="Rooms of different furniture along a corridor whose doors look alike.")
@click.option("--rooms", default=10, show_default=True, help="Of the building.")
@click.option("--recordings", type=click.IntRange(1, 100), help="Write so many into OUT/1, OUT/2 ..., which overlap in part.")
@click.option("--trajectory", type=click.Path(path_type=Path), help="Follow a TUM trajectory instead; the room is made large enough.")
@click.option("--stamps", type=click.Path(path_type=Path), help="Colour and depth stamps for --trajectory, two per line.")
def simulate(
    out: Path, frames: int | None, laps: float | None, speed: float | None, turn_rate: float | None, alias: str | None,
    recordings: int | None, **settings: Any,
) -> None:  # fmt: skip
    """Render a furnished room and a drive through it into the new folder OUT.

    With --building it is a corridor with rooms, driven through twice. Several recordings of one place begin elsewhere on the way, every
    second drives it backwards, the light is another, and stamps begin at 0 in each; truth is told in one frame.

    OUT has the TUM layout: colour and depth images, groundtruth.txt (exact), camera.json, and scene.json with every obstacle. With people,
    a door or a chair that moves, moving/ says which pixels of the colour images show one, scene.json how large a share. The same settings
    give the same recording.

    \b
      slamcli simulate room --seed 3
      slamcli simulate crowd --people 2 --activity beside --activity cross
      slamcli simulate lab --speed 0.15 --turn-rate 0.15 --laps 1 --field-of-view 57 --depth-min 1.2 --depth-max 3.5
      slamcli simulate offices --building --recordings 5
      slamcli simulate unregistered --depth-focal 585
      slamcli simulate hand --trajectory fr1_room.txt --stamps fr1_room_stamps.txt
    """
    from slamcli import console
    from slamcli.datasets.simulate import Simulation, simulate_several
    from slamcli.datasets.simulate import simulate as render
    from slamcli.errors import SlamError

    if settings["stamps"] is not None and settings["trajectory"] is None:
        raise SlamError("--stamps needs --trajectory")
    if speed is not None:
        settings["speed"] = speed
    if turn_rate is not None:
        settings["turn_rate"] = turn_rate
    if frames is None and speed is None and turn_rate is None and settings["trajectory"] is None and not settings["building"]:
        frames = 360 + round(settings["rest"] * settings["rate"])
    settings |= {"frames": frames, "alias": alias or "", "laps": laps or (2.0 if settings["building"] else Simulation.laps)}
    if recordings is None:
        render(out, progress=console.progress, **settings)
        click.echo(out)
    else:
        for folder in simulate_several(out, recordings, progress=console.progress, **settings):
            click.echo(folder)
