"""The rules of import, of what a compiled kernel may call, of what a library may say, and of size. All are read from the source text."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import slamcli
from slamcli.cli.main import cli

PACKAGE = Path(slamcli.__file__).parent
MODULES = sorted(PACKAGE.rglob("*.py"))

# The layers from the ground up. A file imports only from lower layers, and from its own package; packages of one layer do not know
# each other. Files in the root count as packages of their own.
LAYERS = (
    ("errors", "data", "hints"),
    ("__init__", "user_cache"),
    ("files", "interruption", "address_space"),
    ("mapped_memory",),
    ("schema", "parallel", "console", "open3d_loader"),
    ("artifacts",),
    ("jit",),
    ("geometry",),
    ("config",),
    ("vision",),
    ("formats",),
    ("depth", "estimation"),
    ("navigation", "datasets", "sparse_map"),
    ("dense",),
    ("calibration",),
    ("slam",),
    ("stages",),
    ("runs",),
    ("evaluation",),
    ("visualization",),
    ("report", "inspection"),
    ("api",),
    ("batch",),
    ("cli",),
    ("__main__",),
)
LAYER_OF = {package: layer for layer, packages in enumerate(LAYERS) for package in packages}
CLICK = ("cli",)
# Packages of pure numerics: they open no file, and their errors are for a notebook as much as for the command line.
NUMERICAL = ("geometry", "vision", "depth", "estimation", "sparse_map", "dense", "navigation", "calibration", "slam")
FILES = ("slamcli.files", "pathlib", "io", "os", "shutil", "tempfile", "zipfile")
# Packages of the program itself, and what speaks for it. All others are called from Python too: they advise by hint().
OF_THE_PROGRAM = ("cli", "__main__", "hints")
FLAG = r"(^|[\s(\"'`])--?[a-z]"
OF_OTHER_PROGRAMS = re.compile(r"(ulimit|pip install|rtabmap) --?[a-z-]+|gs --?[a-z]+")
NO_ADVICE = {  # words for other programs
    "batch/cluster.py": [" --nthreads 1"],
    "jit/compilation.py": ["-c"],
}
OPEN3D = ("open3d_loader.py",)
EVO = ("evaluation/trajectory_error.py",)


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def package_of(path: Path) -> str:
    return name_of(path).split("/")[0].removesuffix(".py")


def imports(tree: ast.AST) -> Iterator[tuple[str, bool]]:
    """Return each imported module's dotted name, and whether the import is at the top; what only type checkers see is left out."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.Import):
            yield from ((alias.name, isinstance(tree, ast.Module)) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            for alias in node.names:
                yield (f"{node.module}.{alias.name}" if node.module == "slamcli" else str(node.module)), isinstance(tree, ast.Module)
        else:
            yield from ((name, False) for name, _ in imports(node))


def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def packages_used(path: Path) -> set[str]:
    """Return the packages that a file imports from."""
    used = {name.split(".")[1] for name, _ in imports(parsed(path)) if name.startswith("slamcli.")}
    return {name if name in LAYER_OF else "__init__" for name in used} - {package_of(path)}


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_each_file_belongs_to_a_package_and_imports_only_from_layers_below(path: Path) -> None:
    package = package_of(path)
    assert package in LAYER_OF, f"{name_of(path)} is under no rule: give its package a layer"
    upward = {used for used in packages_used(path) if LAYER_OF[used] >= LAYER_OF[package]}
    assert not upward, f"{name_of(path)} must not import from {sorted(upward)}"


def test_every_package_of_the_plan_is_there() -> None:
    assert {package_of(path) for path in MODULES} | {"data"} == set(LAYER_OF)


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_heavy_and_interactive_packages_stay_where_they_belong(path: Path) -> None:
    for name, is_at_top in imports(parsed(path)):
        package, here = name.split(".")[0], name_of(path)
        if package == "click":
            assert here.startswith(CLICK)
        if package == "open3d":
            assert here.startswith(OPEN3D), f"{here} imports open3d"
            assert not is_at_top, f"{here} imports open3d at its top"
        if package == "evo":
            assert here.startswith(EVO), f"{here} imports evo"
            assert not is_at_top, f"{here} imports evo at its top"
        if here.startswith("cli/") and is_at_top:
            assert package in {*sys.stdlib_module_names, "click", "slamcli", "__future__"}, f"{here} imports {package} at its top"


@pytest.mark.parametrize("path", [path for path in MODULES if package_of(path) in NUMERICAL], ids=name_of)
def test_numerical_packages_open_no_file(path: Path) -> None:
    tree = parsed(path)
    opened = {name for name, _ in imports(tree) if name in FILES}
    assert not opened, f"{name_of(path)} imports {sorted(opened)}: files belong to formats/, datasets/ and stages/"
    assert not any(isinstance(node, ast.Call) and ast.unparse(node.func) == "open" for node in ast.walk(tree))


def texts(tree: ast.Module) -> Iterator[str]:
    """Return every text of a file that is no docstring: what a message is made of, whichever way it takes to whom it is for."""
    with_docstring = ast.Module | ast.ClassDef | ast.FunctionDef
    docstrings = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, with_docstring) and node.body and isinstance(node.body[0], ast.Expr)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value


@pytest.mark.parametrize("path", [path for path in MODULES if package_of(path) not in OF_THE_PROGRAM], ids=name_of)
def test_a_library_leaves_commands_and_flags_to_the_program(path: Path) -> None:
    """Whoever calls it from Python has none: what is advised goes through slamcli/hints.py, which knows both ways of saying it."""
    command_line = re.compile(rf"slamcli ({'|'.join(cli.commands)})\b|{FLAG}")
    said = [OF_OTHER_PROGRAMS.sub("", text) for text in texts(parsed(path)) if text not in NO_ADVICE.get(name_of(path), [])]
    assert not [text for text in said if command_line.search(text)]


def is_kernel(function: ast.FunctionDef) -> bool:
    return any(ast.unparse(decorator).startswith("kernel") for decorator in function.decorator_list)


def is_instruction(function: ast.FunctionDef) -> bool:
    """It writes instructions into the kernel that calls it."""
    return any(ast.unparse(decorator) == "intrinsic" for decorator in function.decorator_list)


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_kernel_calls_only_kernels_of_its_own_file_or_of_geometry(path: Path) -> None:
    """Numba's cache does not notice a change in another file's helper; those of geometry/ are covered by the cache's name."""
    tree = parsed(path)
    foreign = {
        alias.asname or alias.name: str(node.module)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("slamcli")
        for alias in node.names
        if not f"{node.module}.{alias.name}".startswith("slamcli.geometry.") or package_of(path) == "geometry"
    }
    if package_of(path) == "geometry":
        foreign = {}
    plain = {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and not is_kernel(node) and not is_instruction(node)}
    for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef) and is_kernel(node)):
        for call in (node for line in function.body for node in ast.walk(line) if isinstance(node, ast.Call)):
            called = ast.unparse(call.func).split(".")[0]
            assert called not in foreign, f"{name_of(path)}: {function.name} calls {called} of {foreign.get(called)}"
            assert called not in plain, f"{name_of(path)}: {function.name} calls {called}, which is not compiled"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_kernels_are_declared_in_one_way_and_keep_to_the_options_that_are_sound(path: Path) -> None:
    """NaN means "no depth", so arithmetic may not assume it away; numba's own threads do not mix with ours."""
    assert name_of(path) == "jit/kernel.py" or "njit" not in path.read_text(encoding="utf-8")
    for function in (node for node in ast.walk(parsed(path)) if isinstance(node, ast.FunctionDef) and is_kernel(node)):
        options = "".join(ast.unparse(decorator) for decorator in function.decorator_list)
        assert "fastmath" not in options, f"{name_of(path)}: {function.name}"  # fused or reordered, sums differ between processors
        assert "parallel=True" not in options, f"{name_of(path)}: {function.name}"


# What a run writes is computed here. BLAS, LAPACK and NumPy's elementary functions choose their code by the processor, and their last digits
# differ; geometry/algebra.py and geometry/elementary.py have what is to be used in their place.
SAME_EVERYWHERE = (*NUMERICAL, "stages", "schema")
OF_THE_PROCESSOR = re.compile(
    r"np\.(dot|vdot|inner|matmul|tensordot|sin|cos|tan|arcsin|arccos|arctan2?|sinh|cosh|tanh|exp2?|expm1|log(2|10|1p)?|power|cbrt|hypot)"
    r"|np\.linalg\.(?!norm$)\w+|math\.(sin|cos|tan|asin|acos|atan2?|exp|log(2|10|1p)?|pow|hypot)|lapack\.\w+|blas\.\w+"
)
SPARSE = {  # products of SciPy's sparse matrices run through its own loops
    "dense/exposure.py": ["M @ sparse.diags(1.0 / per_voxel) @ M.T"],
    "estimation/reduced_camera_system.py": ["seen @ seen.T", "self.matrix @ direction"],
    "estimation/pose_graph_solver.py": ["J @ self._factor.solve(np.ascontiguousarray(J[columns].toarray().T))"],
}
OF_NO_STAGE = ("vision/comparison.py", "navigation/walls.py")  # drawn and exported


@pytest.mark.parametrize("path", [path for path in MODULES if package_of(path) in SAME_EVERYWHERE], ids=name_of)
def test_what_a_run_writes_does_not_follow_the_processor(path: Path) -> None:
    tree = parsed(path)
    if name_of(path) in OF_NO_STAGE:
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert not OF_THE_PROCESSOR.fullmatch(called), f"{name_of(path)}:{node.lineno}: {called}"
            # Without an axis it is the root of a dot product, which is BLAS's.
            assert called != "np.linalg.norm" or any(word.arg == "axis" for word in node.keywords), f"{name_of(path)}:{node.lineno}"
    products = [ast.unparse(node) for node in ast.walk(tree) if isinstance(node, ast.BinOp) and isinstance(node.op, ast.MatMult)]
    known = SPARSE.get(name_of(path), [])
    assert not [text for text in products if not any(text in allowed for allowed in known)]


MOST_LINES = 400  # of a file, which has one subject


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_a_file_is_short_enough_for_one_subject(path: Path) -> None:
    assert len(path.read_text(encoding="utf-8").splitlines()) <= MOST_LINES


BOTH_SIDES = {"Inputs", "Tools"}  # what a stage is promised, and what keeps the promise


def test_the_name_of_a_class_has_one_meaning() -> None:
    homes: dict[str, list[str]] = {}
    for path in MODULES:
        for node in ast.walk(parsed(path)):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes.setdefault(node.name, []).append(name_of(path))
    assert {name: where for name, where in homes.items() if len(where) > 1}.keys() == BOTH_SIDES


# What belongs together travels together: as a record, whose fields say what each thing is.
MOST_PARAMETERS = 8
CHOSEN_BY_NAME = ("api.py: run",)  # its keywords are the options of `slamcli run`, each with a default


def parameters(function: ast.FunctionDef) -> list[str]:
    every = function.args.posonlyargs + function.args.args + function.args.kwonlyargs
    packed = [one for one in (function.args.vararg, function.args.kwarg) if one is not None]
    return [one.arg for one in every + packed if one.arg not in ("self", "cls")]


def is_command(function: ast.FunctionDef) -> bool:
    """Its arguments are the options of the command line."""
    return any(re.match(r"\w+\.command|click\.(command|option|argument)", ast.unparse(one)) for one in function.decorator_list)


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_no_function_takes_a_long_list_of_arguments(path: Path) -> None:
    for function in (node for node in ast.walk(parsed(path)) if isinstance(node, ast.FunctionDef) and not is_command(node)):
        if f"{name_of(path)}: {function.name}" not in CHOSEN_BY_NAME:
            found = parameters(function)
            assert len(found) <= MOST_PARAMETERS, f"{name_of(path)}:{function.lineno}: {function.name} takes {len(found)}: {found}"


def test_help_is_instant_since_it_imports_nothing_heavy() -> None:
    code = "import sys; from slamcli.cli.main import cli; cli(['--help'], standalone_mode=False); print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    loaded = set(done.stderr.split())
    assert "Commands:" in done.stdout
    assert not loaded & {"numpy", "scipy", "numba", "cv2", "open3d", "evo", "matplotlib", "tqdm", "pandas"}
