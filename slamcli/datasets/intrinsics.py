"""Files that hold intrinsics: our camera.toml and camera.json, and what other programs write in JSON, YAML and plain numbers."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slamcli import files
from slamcli.errors import SlamError
from slamcli.geometry.algebra import product
from slamcli.geometry.camera import EQUIDISTANT

NOT_SQUARE, MIRRORED = 1e-3, 0.9  # by which a matrix differs from a rotation at most; its determinant at least
MAX_BYTES = 1 << 20
KEYS = "width height fx fy cx cy k1 k2 p1 p2 k3 depth_scale inverse_depth_offset k4 k5 k6 lens"
DEPTH_KEYS = frozenset(["width", "height", "fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "lens"])
FARTHEST_ASIDE = 1.0  # [m] of a depth camera from colour's, in one housing or on one robot's head
POSE_KEYS = ("T_cd", "translation", "rotation")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# What other programs call our keys; compared without case, after the last dot of the name.
SYNONYMS = {
    "width": ("width", "w", "image_width", "cols", "imagewidth"), "height": ("height", "h", "image_height", "rows", "imageheight"),
    "fx": ("fx", "fl_x", "focal_x", "f_x"), "fy": ("fy", "fl_y", "focal_y", "f_y"),
    "cx": ("cx", "ppx", "principal_x", "c_x"), "cy": ("cy", "ppy", "principal_y", "c_y"),
    "k1": ("k1",), "k2": ("k2",), "p1": ("p1",), "p2": ("p2",), "k3": ("k3",), "k4": ("k4",), "k5": ("k5",), "k6": ("k6",),
    "depth_scale": ("depth_scale", "scale", "png_depth_scale", "depthmapfactor", "depth_factor", "depth_map_factor", "depthscale"),
}  # fmt: skip
PAIRS = {  # of both axes
    ("fx", "fy"): ("focal_length", "focallength", "focal", "focal_lengths"),
    ("cx", "cy"): ("principal_point", "principalpoint", "optical_center", "optical_centre"),
}
MATRICES = ("intrinsic_matrix", "k", "camera_matrix", "intrinsics", "intrinsic", "intrinsic_k", "cam_k", "camera_intrinsic")
EQUIDISTANT_NAMES = ("equidistant", "fisheye", "kannala_brandt", "kannala_brandt4", "opencv_fisheye")
POLYNOMIAL_NAMES = ("", "none", "plumb_bob", "rational_polynomial", "rational", "radtan", "opencv", "brown_conrady", "modified_brown_conrady",
                    "inverse_brown_conrady")  # fmt: skip
DISTORTIONS = ("distortion_coefficients", "d", "coeffs", "dist_coeffs", "distortion", "distortion_coeffs")


def read_camera_file(path: Path) -> tuple[dict[str, Any], dict[str, Any] | None, np.ndarray | None]:
    """Read our own camera file: (keys of the camera, those of its table [depth] or None, the depth camera's pose T_cd (4, 4) or None)."""
    text = _read(path, "a camera file")
    try:
        values = files.parse_toml(text.encode(), source=str(path)) if path.suffix == ".toml" else json.loads(text)
    except (ValueError, RecursionError) as error:  # both parsers' errors and wrong encoding are ValueErrors
        raise SlamError(f"{path}: cannot be parsed ({error})") from error
    depth = values.pop("depth", None) if isinstance(values, dict) else None
    if isinstance(values, dict) and set(values) == {"camera"}:
        values = values["camera"]
    if not isinstance(values, dict) or not values:
        raise SlamError(f"{path}: must be a table with the keys {KEYS}")
    if depth is None:
        return values, None, None
    if not isinstance(depth, dict):
        raise SlamError(f"{path}: depth must be a table with the keys {' '.join(sorted(DEPTH_KEYS))} and {' '.join(POSE_KEYS)}")
    T_cd = _pose(depth, path)
    unknown = sorted(set(depth) - DEPTH_KEYS - set(POSE_KEYS))
    if unknown:
        raise SlamError(f"{path}: depth key {unknown[0]!r} is not known; known are {' '.join(sorted(DEPTH_KEYS))} {' '.join(POSE_KEYS)}")
    return values, {key: value for key, value in depth.items() if key in DEPTH_KEYS}, T_cd


def read_intrinsics(path: Path) -> dict[str, Any]:
    """Read another program's file of intrinsics into keys of Camera; {} where it holds none."""
    text = _read(path, "a file of intrinsics")
    if path.suffix == ".json":
        try:
            return from_value(json.loads(text))
        except (ValueError, RecursionError) as error:
            raise SlamError(f"{path}: cannot be parsed ({error})") from error
    if path.suffix in (".yaml", ".yml"):
        return from_value(_yaml(text, path))
    numbers = _numbers(text)
    return from_numbers(numbers) if numbers is not None else from_value(_key_values(text))


def from_value(value: Any) -> dict[str, Any]:
    """Find intrinsics in what a JSON or YAML file holds: single numbers, or a matrix by one of its names, at any depth of two."""
    if isinstance(value, list):
        return from_numbers(_flat(value))
    if not isinstance(value, Mapping):
        return {}
    flat = {str(key).rsplit(".", 1)[-1].lower(): item for key, item in value.items()}
    for name in ("camera", "camera1", "color", "rgb", "cam0", "color_camera"):
        if isinstance(flat.get(name), Mapping):
            inner = from_value(flat[name])
            if "fx" in inner:
                return {**{key: found for key, found in _scalars(flat).items() if key == "depth_scale"}, **inner}
    found = _scalars(flat)
    for name in MATRICES:
        item = flat.get(name)
        if isinstance(item, Mapping):
            inner = from_numbers(_flat(item["data"])) if isinstance(item.get("data"), list) else from_value(item)
        else:
            inner = from_numbers(_flat(item)) if isinstance(item, list) else {}
        if "fx" in inner and "fx" not in found:
            found = {**found, **inner}
    for name in DISTORTIONS:
        item = flat.get(name)
        item = item.get("data") if isinstance(item, Mapping) else item
        if isinstance(item, list) and "fx" in found:
            found = {**found, **distortion(_flat(item), str(flat.get("distortion_model", "")))}
            break
    return found if "fx" in found else {}


def from_numbers(numbers: list[float]) -> dict[str, Any]:
    """Read a flat list: 3 x 3, 3 x 4 or 4 x 4 by rows or by columns, or fx fy cx cy and distortion coefficients after them."""
    n = len(numbers)
    for size, shape in ((9, (3, 3)), (16, (4, 4)), (12, (3, 4))):
        if n == size:
            matrix = np.array(numbers).reshape(shape)
            for candidate in (matrix, matrix.T):
                k = candidate[:3, :3]
                if k.shape == (3, 3) and k[1, 0] == k[2, 0] == k[2, 1] == 0.0 and k[2, 2] == 1.0 and k[0, 0] > 0.0 and k[1, 1] != 0.0:
                    return {"fx": float(k[0, 0]), "fy": abs(float(k[1, 1])), "cx": float(k[0, 2]), "cy": float(k[1, 2])}
    if 4 <= n <= 12 and numbers[0] > 1.0 and abs(numbers[1]) > 1.0:
        found: dict[str, Any] = {"fx": numbers[0], "fy": abs(numbers[1]), "cx": numbers[2], "cy": numbers[3]}
        return {**found, **distortion(numbers[4:], "")}
    return {}


def distortion(coefficients: list[float], model: str) -> dict[str, Any]:
    """Read distortion coefficients as ROS and OpenCV order them; SlamError for a model that is not known."""
    model = model.lower().replace(" ", "_").removeprefix("distortion.")
    if model in EQUIDISTANT_NAMES:
        values = dict(zip(("k1", "k2", "k3", "k4"), map(float, coefficients[:4]), strict=False))
        return {**values, "lens": EQUIDISTANT}
    if model not in POLYNOMIAL_NAMES:
        raise SlamError(f"distortion model {model!r} is not known; known are plumb_bob, rational_polynomial and equidistant")
    return {name: float(value) for name, value in zip(COEFFICIENTS, coefficients, strict=False) if value != 0.0}


def _scalars(flat: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, names in SYNONYMS.items():
        value = next((flat[name] for name in names if isinstance(flat.get(name), (int, float)) and not isinstance(flat[name], bool)), None)
        if value is not None:
            found[key] = value
    for keys, names in PAIRS.items():
        both = next((numbers for name in names if len(numbers := _flat(flat.get(name))) == 2), None)
        if both is not None:
            found = {**dict(zip(keys, both, strict=True)), **found}
    if 0 < found.get("depth_scale", 1.0) < 0.5:  # metres per unit
        found["depth_scale"] = 1.0 / found["depth_scale"]
    if "fy" in found:
        found["fy"] = abs(found["fy"])  # ICL-NUIM's is negative
    return found


def _flat(value: Any) -> list[float]:
    try:
        return [float(x) for x in np.asarray(value, dtype=np.float64).ravel()]
    except (TypeError, ValueError, OverflowError):
        return []


def _numbers(text: str) -> list[float] | None:
    """Parse a text of nothing but numbers; None where there is a word in it."""
    lines = [line.split("#")[0] for line in text.splitlines()]
    tokens = re.split(r"[\s,;\[\]]+", " ".join(lines).strip().strip("[]"))
    try:
        return [float(token) for token in tokens if token]
    except ValueError:
        return None


def _key_values(text: str) -> dict[str, float]:
    """Read lines ``fx = 525.0`` or ``fx: 525.0``."""
    found = re.findall(r"^\s*([A-Za-z_.][\w.]*)\s*[:=]?\s+([-+]?\d[\d.eE+-]*)\s*;?\s*$", text.replace("=", " = "), re.MULTILINE)
    found += re.findall(r"^\s*([A-Za-z_.][\w.]*)\s*[:=]\s*([-+]?\d[\d.eE+-]*)\s*;?\s*$", text, re.MULTILINE)
    values: dict[str, float] = {}
    for key, number in found:
        try:
            values[key] = float(number)
        except ValueError:
            continue
    return values


def _yaml(text: str, path: Path) -> Any:
    import yaml

    plain = re.sub(r"!!\S+", "", re.sub(r"^%YAML.*$", "", text, flags=re.MULTILINE))  # OpenCV's heading and its tags
    try:
        return yaml.safe_load(plain)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise SlamError(f"{path}: cannot be parsed as YAML") from error


def _pose(depth: Mapping[str, Any], path: Path) -> np.ndarray | None:
    """Read where a depth camera sits: T_cd as 4 x 4, or translation [m] and rotation (3 x 3, or a quaternion x y z w)."""
    from slamcli.geometry import se3

    wrong = f"{path}: depth.T_cd must be 4 x 4, depth.translation 3 numbers [m], depth.rotation 3 x 3 or a quaternion x y z w"
    if not any(key in depth for key in POSE_KEYS):
        return None
    T_cd = np.eye(4)
    if "T_cd" in depth:
        flat = _flat(depth["T_cd"])
        if len(flat) != 16:
            raise SlamError(wrong)
        T_cd = np.array(flat).reshape(4, 4)
    translation, rotation = _flat(depth.get("translation", T_cd[:3, 3])), _flat(depth.get("rotation", T_cd[:3, :3]))
    if len(translation) != 3 or len(rotation) not in (4, 9) or not np.isfinite([*translation, *rotation]).all():
        raise SlamError(wrong)
    if len(rotation) == 4 and np.linalg.norm(rotation, axis=-1) > 1e-6:
        T_cd = se3.from_quaternion(np.array([translation]), np.array([rotation]))[0]
    elif len(rotation) == 9:
        T_cd[:3, :3], T_cd[:3, 3] = np.array(rotation).reshape(3, 3), translation
    if (
        np.abs(product(T_cd[:3, :3], T_cd[:3, :3].T) - np.eye(3)).max() > NOT_SQUARE
        or not product(np.cross(T_cd[:3, 0], T_cd[:3, 1]), T_cd[:3, 2]) > MIRRORED
    ):
        raise SlamError(f"{path}: the rotation of the depth camera is none")
    if not np.square(T_cd[:3, 3]).sum() < FARTHEST_ASIDE**2:
        raise SlamError(f"{path}: depth.translation is farther than {FARTHEST_ASIDE:g} m; give it in metres, not in millimetres")
    return T_cd


def _read(path: Path, what: str) -> str:
    try:
        return files.read_bytes(path, limit=MAX_BYTES).decode("utf-8-sig")
    except OSError as error:
        raise SlamError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise SlamError(f"{path}: cannot be parsed ({error})") from error
