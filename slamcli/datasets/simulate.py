"""Simulated recordings: a furnished room, people in it, a motion through it and a camera, written in the TUM layout with exact truth."""

import json
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slamcli.datasets.lists import read_text
from slamcli.datasets.simulated import building, drive, moved_things, noise, people, room
from slamcli.datasets.simulated.drive import Motion, Pace
from slamcli.datasets.simulated.figures import Figure
from slamcli.datasets.simulated.moved_things import Moved
from slamcli.datasets.simulated.noise import SensorNoise
from slamcli.datasets.simulated.room import Furnishing
from slamcli.datasets.simulated.scene import Patch, Scene, with_textured_share
from slamcli.datasets.staging import staged
from slamcli.errors import SlamError
from slamcli.formats.trajectory import read_tum, write_tum
from slamcli.geometry import se3
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import Camera
from slamcli.parallel import least_instructions_in_opencv, ordered_map
from slamcli.schema import Trajectory

FORMAT = 1  # of scene.json
DEPTH_SCALE = 5000.0
TEXEL_AT_640 = 0.004  # [m] finest texture pixel for images 640 px wide: what such a camera resolves at 2 m
MAX_TEXELS = 30e6
PATH_MARGIN = 1.35  # [m] of the robot's round from the walls
AHEAD = 0.35  # [m] on either side of the robot, over which the direction of its way through a building is taken
MOST_PEOPLE = 20
SIDES = (4.0, 50.0)  # [m] of a room: the furniture needs so much, the textures fill the memory
MOST_RECORDINGS = 100
OVERLAP = 0.4  # of a recording's part of the way that the next one drives too
DEPTH_AXIS = np.array([0.5, 0.7, 0.5])  # about which a depth camera of its own is turned, nearly of length 1
LIGHTS = 1.0, 0.75, 1.2, 0.85, 1.1  # brightness of one recording after the other
AROUND_TRAJECTORY = 1.6  # [m] from a given trajectory to the walls
PNG_SETTINGS = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]

Progress = Callable[..., Iterable]


@dataclass(frozen=True)
class Simulation:
    """What to simulate; lengths in metres, angles in degrees."""

    seed: int = 0
    frames: int | None = 360  # None = as many as speed, turn rate and rate give
    laps: float = 1.09
    speed: float = 0.6  # [m/s], at most
    turn_rate: float = 0.8  # [rad/s], at most
    rate: float = 15.0  # [Hz]
    rest: float = 0.0  # [s] of standing still half-way, not with a trajectory
    width: int = 640
    height: int = 480
    field_of_view: float = 62.7  # horizontal
    camera_height: float = 0.75
    pitch: float = -12.0  # negative looks down
    noise: str = "kinect"  # or "none": exact images
    depth_min: float = 0.4  # of the noisy camera
    depth_max: float = 5.0
    depth_focal: float | None = None  # [px] of a depth camera of its own; None = depth is registered to colour
    depth_aside: float = 0.025  # where it sits, to the right of the colour camera,
    depth_turn: float = 0.5  # and by how much it is turned, about DEPTH_AXIS
    holes: float = 0.0  # share of all surface that gives no depth, as glass and black or shiny things do
    textured: float = 1.0  # share of objects and walls with a picture on them
    dark: bool = False  # nothing but noise in the colour images; depth brings its own light
    movable: bool = False  # a parcel that is taken away,
    gone_from: float = 0.5  # after this share of the frames; 1 = never
    door: bool = False  # a door opens while the camera looks at it
    moved_chair: bool = False  # a chair stands elsewhere from a moment on in which it is out of view
    people: int = 0  # who walk about in view of the camera
    activities: tuple[str, ...] = ()  # that they take up in turn; () = all there are
    start: float = 0.0  # share of the round at which the drive begins
    backwards: bool = False  # drive the round the other way
    light: float = 1.0  # brightness; another exposure, too
    take: int = 0  # number of the recording of one scene: another draw of the noise
    twin: int = 0  # another place of the same makers: equal patterns and pieces, arranged otherwise; of a corridor other ends
    alias: str = ""  # "posters": opposite walls are the same; "corridor": equal doors
    room: tuple[float, float] = (8.0, 5.0)
    empty: bool = False  # nothing stands in the room
    building: bool = False  # rooms along a corridor instead of one room
    rooms: int = 10  # of the building
    trajectory: Path | None = None  # TUM file to follow instead of driving rounds
    stamps: Path | None = None  # "colour depth" stamps for it

    def camera(self) -> Camera:
        """Return the camera, without distortion."""
        focal = self.width / 2 / np.tan(np.radians(self.field_of_view) / 2)
        return Camera(self.width, self.height, focal, focal, (self.width - 1) / 2, (self.height - 1) / 2, depth_scale=DEPTH_SCALE)

    def depth_camera(self) -> tuple[Camera, np.ndarray] | None:
        """Return the depth camera and T_cd (4, 4), depth camera to colour camera; None where depth is registered to colour."""
        if self.depth_focal is None:
            return None
        T_cd = se3.exp(np.concatenate([np.zeros(3), np.radians(self.depth_turn) * DEPTH_AXIS]))
        T_cd[0, 3] = self.depth_aside
        return replace(self.camera(), fx=self.depth_focal, fy=self.depth_focal), T_cd


def simulate(out: Path, *, progress: Progress, workers: int = 2, **settings: Any) -> Path:
    """Write a simulated recording into the new folder `out`; see Simulation for the settings.

    The same settings give the same bytes. The folder appears only when complete.
    """
    what = Simulation(**settings)
    _check(what)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SlamError(f"{out}: exists already; name a new folder")
    scene, motion = build(what)
    figures = people.populate(
        motion, scene.low, scene.high, people=what.people, activities=what.activities or tuple(people.ACTIVITIES),
        drives=what.trajectory is None, seed=what.seed,
    )  # fmt: skip
    moved = _moved_things(what, scene, motion)
    figures += [one.figure for one in moved]
    with staged(out) as staging, least_instructions_in_opencv():
        (staging / "rgb").mkdir()
        (staging / "depth").mkdir()
        if figures:
            (staging / "moving").mkdir()
        shares = _write_images(staging, what, scene, motion, figures, progress, workers)
        last = [solid for one in moved for solid in one.last]
        _write_lists(staging, what, replace(scene, solids=[*scene.solids, *last]), motion, figures, shares)
    return out


def _moved_things(what: Simulation, scene: Scene, motion: Motion) -> list[Moved]:
    """Make the door and the chair, as far as they are asked for."""
    found = []
    if what.door:
        doorway = max(scene.doorways, key=lambda one: moved_things.seconds_in_view(one, motion))
        found.append(moved_things.door(doorway, motion, np.random.default_rng([what.seed, 8])))
    if what.moved_chair:
        found.append(moved_things.chair(scene.chair_places, motion))
    return found


def simulate_several(out: Path, recordings: int, *, progress: Progress, workers: int = 2, **settings: Any) -> list[Path]:
    """Write several recordings of one scene into the new folder `out`, as 1, 2, ... ; their true poses are told in one frame.

    Each begins elsewhere on the way, every second drives it the other way, and each has a light and stamps of its own. Each covers
    `OVERLAP` of the part of the next, and all together as many rounds as `laps` says. What is there already stays.
    """
    if not 1 <= recordings <= MOST_RECORDINGS:
        raise SlamError(f"recordings = {recordings}: must be from 1 to {MOST_RECORDINGS}")
    laps = float(settings.get("laps", Simulation.laps))
    share = (1.0 + OVERLAP) * laps / recordings
    made = []
    for take in range(recordings):
        backwards = take % 2 == 1
        start = (take * laps / recordings + (share if backwards else 0.0)) % 1.0
        own: dict[str, object] = {"laps": share, "start": start, "backwards": backwards, "light": LIGHTS[take % len(LIGHTS)], "take": take}
        folder = out / str(take + 1)
        if not folder.is_dir():
            out.mkdir(parents=True, exist_ok=True)
            simulate(folder, progress=progress, workers=workers, **{**settings, **own})
        made.append(folder)
    return made


def build(what: Simulation) -> tuple[Scene, Motion]:
    """Make the motion and a room around it."""
    if what.trajectory is not None:
        return _around_trajectory(what, what.trajectory)
    if what.building:
        path = building.way(what.rooms)
        length = float(np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1).sum())
        motion = _drive(what, path, np.random.default_rng([what.seed, 2]), ahead=AHEAD / length)
        return building.house(what.rooms, path, seed=what.seed), motion
    low, high = np.zeros(3), np.array([*what.room, room.HEIGHT])
    margin = PATH_MARGIN
    if what.alias == "corridor":
        high, margin = np.array([16.0, 2.4, room.HEIGHT]), 0.75
    rng = np.random.default_rng([what.seed, 2])
    path = drive.closed_path(low, high, margin, rng)
    motion = _drive(what, path, rng)
    if what.alias == "corridor":
        return room.corridor(low, high, seed=what.seed, twin=what.twin), motion
    centres = np.column_stack([path, np.zeros(len(path))])  # the robot itself is on the floor
    return room.furnished_room(low, high, centres, seed=what.seed, furnishing=_furnishing(what)), motion


def _furnishing(what: Simulation) -> Furnishing:
    return Furnishing(what.twin, what.alias == "posters", what.movable, what.empty, what.moved_chair)


def _drive(what: Simulation, path: np.ndarray, rng: np.random.Generator, **more: float) -> Motion:
    """Drive along a closed path (N, 2) as it is asked for; more : arguments of `drive.rounds`."""
    path = drive.turned(path, start=what.start, backwards=what.backwards)
    pace = Pace(what.frames, what.speed, what.turn_rate, what.rate, what.laps, what.rest)
    return drive.rounds(path, pace, height=what.camera_height, pitch=np.radians(what.pitch), rng=rng, **more)


def _around_trajectory(what: Simulation, trajectory: Path) -> tuple[Scene, Motion]:
    """Follow a recorded trajectory through a room made large enough for it; its z axis must point up, as in the TUM data set."""
    followed = read_tum(trajectory)
    lift = max(0.0, 0.4 - float(followed.T_wc[:, 2, 3].min()))
    T_lw = np.eye(4)
    T_lw[2, 3] = lift
    followed = Trajectory(stamp=followed.stamp, T_wc=product(T_lw, followed.T_wc))
    stamps = read_stamps(what.stamps) if what.stamps is not None else None
    motion = drive.along(followed, stamps, rate=what.rate, frames=what.frames)
    centres = np.concatenate([motion.colour_T_lc[:, :3, 3], motion.depth_T_lc[:, :3, 3]])
    low, high = centres.min(axis=0) - AROUND_TRAJECTORY, centres.max(axis=0) + AROUND_TRAJECTORY
    for axis, least in enumerate((5.0, 4.0)):
        lacking = max(0.0, least - (high[axis] - low[axis])) / 2
        low[axis], high[axis] = low[axis] - lacking, high[axis] + lacking
    low[2], high[2] = 0.0, max(room.HEIGHT, float(centres[:, 2].max()) + 0.5)
    return room.furnished_room(low, high, centres, seed=what.seed, furnishing=_furnishing(what)), motion


def read_stamps(path: Path) -> np.ndarray:
    """Read lines ``colour_stamp depth_stamp``."""
    expected = f"{path}: expected lines 'colour_stamp depth_stamp'"
    try:
        lines = [line.split("#")[0].split() for line in read_text(path).splitlines()]
        rows = np.array([[float(token) for token in line] for line in lines if line])
    except ValueError as error:
        raise SlamError(f"{expected} ({error})") from error
    if rows.ndim != 2 or rows.shape[1] != 2 or not np.isfinite(rows).all():
        raise SlamError(expected)
    return rows[np.unique(rows[:, 0], return_index=True)[1]]


def _check(what: Simulation) -> None:
    bounds = {
        "frames": (1, 1_000_000), "laps": (0.01, 1000), "speed": (0.001, 100), "turn_rate": (0.001, 100), "rate": (0.1, 1000), "rest": (0, 3600),
        "width": (32, 4096), "height": (32, 4096), "field_of_view": (20, 120), "camera_height": (0.1, 2.4), "pitch": (-80, 80),
        "start": (0, 1), "light": (0.05, 4), "take": (0, 1_000_000), "twin": (0, 1_000_000),
        "depth_aside": (-0.2, 0.2), "depth_turn": (-10, 10), "depth_focal": (32, 4096),
        "rooms": (1, building.MOST_ROOMS), "gone_from": (0, 1), "depth_min": (0, 10), "depth_max": (0.1, 13), "textured": (0, 1), "holes": (0, 1), "seed": (0, 2**31), "people": (0, MOST_PEOPLE),
    }  # fmt: skip
    for name, (least, most) in bounds.items():
        value = getattr(what, name)
        if value is not None and not least <= value <= most:
            raise SlamError(f"{name} = {value}: must be from {least} to {most}")
    if what.noise not in ("kinect", "none") or what.alias not in ("", "posters", "corridor"):
        raise SlamError(f"noise = {what.noise!r}, alias = {what.alias!r}: known are noise kinect, none and alias posters, corridor")
    if unknown := sorted(set(what.activities) - set(people.ACTIVITIES)):
        raise SlamError(f"activities: {unknown[0]!r} is unknown; known are {', '.join(people.ACTIVITIES)}")
    if what.building and (what.people or what.movable or what.alias or what.trajectory is not None):
        raise SlamError("building: takes no people, moved object, alias or trajectory")
    if (what.door or what.moved_chair) and (what.building or what.alias == "corridor"):
        raise SlamError("door, moved_chair: only in a room, not in a building or a corridor")
    if what.depth_min >= what.depth_max:
        raise SlamError(f"depth_min = {what.depth_min}, depth_max = {what.depth_max}: the first must be smaller")
    if min(what.room) < SIDES[0] or max(what.room) > SIDES[1]:
        raise SlamError(f"room = {what.room}: sides must be from {SIDES[0]:g} to {SIDES[1]:g} m")


def _write_lists(folder: Path, what: Simulation, scene: Scene, motion: Motion, figures: list[Figure], shares: np.ndarray) -> None:
    for kind, stamps in (("rgb", motion.colour_stamp), ("depth", motion.depth_stamp)):
        lines = [f"{stamp:.6f} {kind}/{stamp:.6f}.png\n" for stamp in stamps]
        (folder / f"{kind}.txt").write_text(f"# simulated {kind} images\n# timestamp filename\n" + "".join(lines))
    stamp, first = np.unique(np.concatenate([motion.colour_stamp, motion.depth_stamp]), return_index=True)
    poses = np.concatenate([motion.colour_T_lc, motion.depth_T_lc])[first]
    write_tum(folder / "groundtruth.txt", Trajectory(stamp=stamp, T_wc=poses))
    (folder / "camera.json").write_text(json.dumps(_calibration(what), indent=1) + "\n")
    n_with = int(what.gone_from * len(motion.colour_stamp))
    gone_from = float(motion.colour_stamp[n_with]) if n_with < len(motion.colour_stamp) else None
    about = {
        "format": FORMAT,
        "frame": "level: z up, floor z = 0, metres, radians; groundtruth.txt maps the colour camera to it",
        "seed": what.seed,
        "noise": what.noise,
        **scene.to_dict(),
        "gone": [{"name": solid.name, "from": gone_from} for solid in scene.solids if solid.is_movable and gone_from is not None],
    }
    if figures:
        about["moving"] = [
            {"name": figure.name, "type": figure.kind, "value": k + 1, "share": shares[:, k].round(4).tolist()}
            for k, figure in enumerate(figures)
        ]
    (folder / "scene.json").write_text(json.dumps(about, indent=1) + "\n")


def _calibration(what: Simulation) -> dict[str, Any]:
    """Return what the camera file tells: the colour camera and, where it is another, the depth camera and where it sits."""
    beside = what.depth_camera()
    if beside is None:
        return what.camera().to_dict()
    camera, T_cd = beside
    depth = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")} | {"T_cd": T_cd.tolist()}
    return {**what.camera().to_dict(), "depth": depth}


def _write_images(
    folder: Path, what: Simulation, scene: Scene, motion: Motion, figures: list[Figure], progress: Progress, workers: int
) -> np.ndarray:
    """Write colour and depth images, and which pixels of the colour images show figures; returns the shares (F, figures) of these."""
    from slamcli.datasets.simulated.figure_raycast import Crowd
    from slamcli.datasets.simulated.raycast import Renderer

    patches = with_textured_share(scene.patches(), what.textured, what.seed)
    texel = _texel(patches, what.width)
    renderer = Renderer(patches, scene, what.camera(), texel=texel)
    crowd = Crowd(figures, what.camera(), texel=texel, seed=what.seed) if figures else None
    shares = np.zeros((len(motion.colour_stamp), len(figures)))
    n = len(motion.colour_stamp)
    depth_camera, T_cd = what.depth_camera() or (what.camera(), np.eye(4))
    depth_renderer, depth_crowd = renderer.through(depth_camera), crowd and crowd.through(depth_camera)
    depth_T_lc = product(motion.depth_T_lc, T_cd)
    is_one_view = what.depth_focal is None and np.array_equal(motion.colour_stamp, motion.depth_stamp)
    sensor = replace(SensorNoise(), near=what.depth_min, far=what.depth_max)
    normal_noise = noise.NormalNoise((what.height, what.width), what.seed)

    def one(i: int) -> None:
        cv2.ipp.setUseIPP(False)  # each thread has a switch of its own, beside `least_instructions_in_opencv`
        rng = np.random.default_rng([what.seed, 3, i, *([what.take] if what.take else [])])
        shown = i < int(what.gone_from * n)
        rgb, depth, cosine = renderer.render(motion.colour_T_lc[i], with_movable=shown)
        if crowd is not None:
            drawn = crowd.draw(motion.colour_T_lc[i], motion.colour_stamp[i], rgb, depth, cosine)
            rgb, depth, cosine = drawn.rgb, drawn.depth, drawn.cosine
            shares[i] = np.bincount(drawn.owner.ravel(), minlength=len(figures) + 1)[1:] / depth.size
            _write_png(folder / "moving" / f"{motion.colour_stamp[i]:.6f}.png", drawn.owner)
        if not is_one_view:
            depth, cosine = depth_renderer.depth(depth_T_lc[i], with_movable=shown)
            if depth_crowd is not None:
                drawn = depth_crowd.draw(depth_T_lc[i], motion.depth_stamp[i], rgb, depth, cosine)
                depth, cosine = drawn.depth, drawn.cosine
        if what.dark:
            rgb = np.zeros_like(rgb)
        if what.light != 1.0:
            rgb = rgb * np.float32(what.light)
        lost = noise.without_reading(depth, depth_T_lc[i], depth_camera, share=what.holes, seed=what.seed) if what.holes else None
        if what.noise == "kinect":
            depth = noise.depth_noise(depth, cosine, depth_camera.fx, sensor, normal_noise, rng)
            picture = noise.colour_noise(rgb, sensor, normal_noise, rng)
        else:
            picture = np.clip(rgb + 0.5, 0, 255).astype(np.uint8)
        units = np.round(depth.astype(np.float64) * DEPTH_SCALE)
        units[units > np.iinfo(np.uint16).max] = 0
        if lost is not None:
            units[lost] = 0
        _write_png(folder / "rgb" / f"{motion.colour_stamp[i]:.6f}.png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
        _write_png(folder / "depth" / f"{motion.depth_stamp[i]:.6f}.png", units.astype(np.uint16))

    for _ in progress(ordered_map(one, range(n), workers=workers), "simulate", n):
        pass
    return shares


def _texel(patches: list[Patch], width: int) -> float:
    area = sum(np.linalg.norm(patch.a, axis=-1) * np.linalg.norm(patch.b, axis=-1) for patch in patches)
    return max(TEXEL_AT_640 * 640 / width, float(np.sqrt(area / MAX_TEXELS)))


def _write_png(path: Path, image: np.ndarray) -> None:
    _, data = cv2.imencode(".png", image, PNG_SETTINGS)
    path.write_bytes(data.tobytes())
