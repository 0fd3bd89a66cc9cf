"""The tree keeps its shape: imports go one way and in no circle, nothing public is dead, no function is large without a reason, and names,
devices and dangers stay where they belong.
"""

import ast
import gc
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.patience import PATIENCE_SECONDS

ROOT = Path(__file__).parent.parent
LAYERS = (
    "drgs.maths", "drgs.exchange", "drgs.scene", "drgs.deform", "drgs.render", "drgs.reconstruct", "drgs.convert", "drgs.evaluate",
    "drgs_worker.store", "drgs_worker.jobs", "drgs_worker", "drgs_server",
)  # fmt: skip
"""Each may import those before it."""
TOP_FILES = {
    "drgs/__init__.py",
    "drgs/brief_waits.py",
    "drgs/cli.py",
    "drgs/__main__.py",
    "drgs/cli_answers.py",
    "drgs/cli_endings.py",
    "drgs/cli_options.py",
    "drgs/cli_progress.py",
    "drgs/compiled_kernels.py",
    "drgs/crowding.py",
    "drgs/installation.py",
    "drgs/openmp.py",
    "drgs/warp_torch.py",
}
"""Files of drgs that belong to no layer."""


def tracked_files() -> list[str]:
    """Paths of what is, or is about to be, in the repository."""
    listed = subprocess.run(["git", "ls-files", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode != 0:  # an unpacked archive without git
        return [
            str(p.relative_to(ROOT))
            for p in ROOT.rglob("*")
            if p.is_file() and not any(x.startswith(".") or x == "node_modules" for x in p.relative_to(ROOT).parts)
        ]
    return [name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]


FILES = tracked_files()
PYTHON = [name for name in FILES if name.endswith(".py")]
PRODUCT = [name for name in PYTHON if name.startswith(("drgs/", "worker/", "server/"))]


@cache
def syntax(name: str) -> ast.Module:
    gc.disable()  # all that is made is kept: looking through it for garbage takes as long as making it
    try:
        return ast.parse((ROOT / name).read_text(), name)
    finally:
        gc.enable()


@cache
def nodes(name: str) -> list[ast.AST]:
    """All of a file's tree, which to walk takes longer than to look through."""
    return list(ast.walk(syntax(name)))


def imports(tree: ast.AST) -> set[str]:
    """Dotted names that the code imports, wherever in it."""
    return imports_among(ast.walk(tree))


def imports_among(among: Iterable[ast.AST]) -> set[str]:
    found: set[str] = set()
    for node in among:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return found


@cache
def imports_of(name: str) -> set[str]:
    return imports_among(nodes(name))


def is_type_checking(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def module_level_imports(tree: ast.Module) -> set[str]:
    """What importing the file imports: neither inside functions nor for type checkers only."""
    statements = [
        node
        for node in tree.body
        if not is_type_checking(node) and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)
    ]
    return set().union(*(imports(node) for node in statements)) if statements else set()


def dotted_name(path: str) -> str:
    """Of the module in a file: the services' folders hold their import packages."""
    return path.removeprefix("server/").removeprefix("worker/").removesuffix(".py").replace("/", ".")


def layer(dotted: str) -> int | None:
    """Place in LAYERS of a module."""
    return next((k for k, name in enumerate(LAYERS) if dotted == name or dotted.startswith(name + ".")), None)


def module_name(path: str) -> str:
    """As it is imported: a package's name for its `__init__.py`."""
    return dotted_name(path).removesuffix(".__init__")


MODULES = {module_name(name): name for name in PYTHON if name in PRODUCT or name.startswith("benchmarks/")}


def imported_modules(module: str) -> set[str]:
    """Modules of the product and of the benchmarks that this one imports, inside functions and for type checkers too.

    A module that names its neighbour runs their package's `__init__` as well; that is how packages work, and not counted.
    """
    found: set[str] = set()
    package = module if MODULES[module].endswith("__init__.py") else module.rpartition(".")[0]
    for node in nodes(MODULES[module]):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            source = ".".join([*above, *filter(None, [node.module])])
            found |= {name if (name := f"{source}.{alias.name}") in MODULES else source for alias in node.names}
    return (found & set(MODULES)) - {module}


def cycles(graph: dict[str, set[str]]) -> set[frozenset[str]]:
    """Sets of nodes that reach each other."""
    reached: dict[str, set[str]] = {}
    for start in graph:
        reached[start], front = set(), [start]
        while front:
            further = graph[front.pop()] - reached[start]
            reached[start] |= further
            front += further
    return {frozenset(b for b in reached[a] if a in reached[b]) for a in graph if a in reached[a]}


def test_no_modules_import_each_other_in_a_circle():
    assert [sorted(cycle) for cycle in cycles({module: imported_modules(module) for module in MODULES})] == []


def parts_graph(package: str) -> dict[str, set[str]]:
    """Which of a package's folders and files import which others of them."""

    def part(module: str) -> str:
        return ".".join(module.split(".")[: package.count(".") + 2])

    inside = {module for module in MODULES if module.startswith(f"{package}.")}
    graph: dict[str, set[str]] = {part(module): set() for module in inside}
    for module in inside:
        graph[part(module)] |= {part(found) for found in imported_modules(module) & inside} - {part(module)}
    return graph


@pytest.mark.parametrize("package", ["drgs.deform", "drgs.render", "benchmarks"])
def test_the_parts_of_a_package_import_each_other_in_no_circle(package: str):
    assert [sorted(cycle) for cycle in cycles(parts_graph(package))] == []


def test_the_film_reads_the_frame_and_posing_reads_what_moves():
    assert "drgs.render.progressive" in parts_graph("drgs.render")["drgs.render.film"]
    assert {f"drgs.deform.{part}" for part in ("displace", "rig", "matter", "carry")} < parts_graph("drgs.deform")["drgs.deform.pose_scene"]


def test_cycles_are_found():
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set()}) == {frozenset("abc")}


def test_imports_go_one_way():
    in_layers = {name: own for name in PRODUCT if (own := layer(dotted_name(name))) is not None}
    assert len(in_layers) > 400
    for name, own in in_layers.items():
        upwards = {found for found in imports_of(name) if (layer(found) or 0) > own}
        assert not upwards, f"{name} lies in {LAYERS[own]} and imports {sorted(upwards)}"


def test_maths_imports_nothing_else_of_drgs():
    for name in (name for name in PRODUCT if name.startswith("drgs/maths/")):
        found = {dotted for dotted in imports_of(name) if dotted.startswith("drgs.") and not dotted.startswith("drgs.maths")}
        assert not found, f"{name} imports {sorted(found)}"


def test_every_file_of_drgs_belongs_to_a_layer():
    strays = [
        name for name in PRODUCT if name.startswith("drgs/") and layer(dotted_name(name)) is None and not name.startswith("drgs/reference/")
    ]
    assert set(strays) <= TOP_FILES


def test_the_reference_is_for_tests_and_benchmarks_only():
    users = [
        name for name in PRODUCT if not name.startswith("drgs/reference/") and any(d.startswith("drgs.reference") for d in imports_of(name))
    ]
    assert users == []


def test_server_and_worker_import_no_torch_at_module_level():
    heavy = ("torch", "warp")
    for name in (name for name in PRODUCT if name.startswith(("server/", "worker/"))):
        found = {dotted for dotted in module_level_imports(syntax(name)) if dotted.split(".")[0] in heavy}
        assert not found, f"{name} imports {sorted(found)} when it is imported"


@pytest.mark.slow
@pytest.mark.parametrize("module", ["drgs_server.app", "drgs_worker.run"])
def test_importing_a_service_does_not_bring_torch_along(module: str):
    program = f"import sys, {module}; sys.exit(sorted({{'torch', 'warp'}} & set(sys.modules)) or None)"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert result.returncode == 0, result.stderr


def test_importing_the_client_brings_only_what_a_client_needs():
    heavy = {"alembic", "av", "dbos", "fastapi", "numpy", "obstore", "sqlalchemy", "starlette", "torch", "uvicorn", "warp"}
    program = f"import sys; from drgs import Client; sys.exit(sorted({heavy} & set(sys.modules)) or None)"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert result.returncode == 0, result.stderr


def loaded_with(module: str) -> set[str]:
    """Modules of the product, and names of other packages, that importing a module loads at once."""
    loaded: set[str] = set()
    front = [module]
    while front:
        name = front.pop()
        above = [name.rsplit(".", k)[0] for k in range(name.count(".") + 1)]  # packages run their `__init__`
        for found in {one for one in above if one in MODULES} - loaded:
            loaded.add(found)
            front += module_level_imports(syntax(MODULES[found]))
        if name.split(".")[0] not in MODULES:
            loaded |= {name, *above}
    return loaded


@pytest.mark.parametrize(
    ("module", "late"),
    [
        ("drgs_worker.jobs.file_tool", {"torch", "warp", "scipy", "PIL", "pydantic", "sqlalchemy", "drgs.exchange"}),
        ("drgs.scene.asset", {"warp", "scipy", "trimesh"}),
        (
            "drgs.deform.pose_scene",
            {"warp", "scipy", "igl", "drgs.deform.matter", "drgs.deform.displace.arap", "drgs.deform.rig", "drgs.exchange.gltf_rig"},
        ),
        ("drgs.render.render_frame", {"scipy", "drgs.deform", "drgs.render.integrate.wavefront"}),
        ("drgs.convert.export_asset", {"igl", "trimesh", "drgs.deform.matter.mpm", "drgs.convert.page", "drgs.reconstruct"}),
        ("drgs.evaluate.look_at_capture", {"trimesh", "scipy.stats", "skimage.color", "skimage.filters", "drgs.render"}),
    ],
)
def test_a_process_for_one_file_loads_what_it_needs_and_no_more(module: str, late: set[str]):
    # Each look, upload and export is a process: what it imports its caller waits for, where it is not forked off one that has loaded all.
    assert {name for name in late if name.startswith("drgs")} <= set(MODULES), "what is moved is named here as it is called now"
    assert loaded_with(module) & late == set()


def test_the_library_knows_no_http_and_no_service():
    network = {"aiohttp", "fastapi", "http", "httpx", "requests", "socket", "starlette", "urllib.request", "uvicorn", "websockets"}
    services = {"drgs_server", "drgs_worker"}
    late = {"drgs/cli.py", "drgs/__init__.py"}
    for name in (name for name in PRODUCT if name.startswith("drgs/")):
        dotted_names = imports_of(name)
        roots = {dotted.split(".")[0] for dotted in dotted_names}
        assert not (roots | dotted_names) & network, f"{name} imports {sorted((roots | dotted_names) & network)}"
        # The command line starts the service when it is told to; `drgs.Client` is found when it is asked for.
        if name not in late:
            assert not roots & services, f"{name} imports {sorted(roots & services)}"
    at_once = {dotted.split(".")[0] for name in late for dotted in module_level_imports(syntax(name))}
    assert not at_once & services


def test_names_say_something():
    empty = re.compile(r"(^|/)(utils?|helpers?|common|misc)(\.[a-z]+)?(/|$)")
    assert [name for name in FILES if empty.search(name)] == []


def test_devices_are_those_of_the_inputs():
    # `device_from_name` is where a user's word becomes a device; the command line has that word as a choice.
    allowed = {"drgs/warp_torch.py", "drgs/cli_options.py"}
    named = [
        name
        for name in PRODUCT
        if name.startswith("drgs/") and name not in allowed and re.search(r"""["']cuda(:\d)?["']""", (ROOT / name).read_text())
    ]
    assert named == []


def test_pickle_is_met_only_by_the_restricted_reader():
    dangerous = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal"}
    users = [name for name in PRODUCT if dangerous & {dotted.split(".")[0] for dotted in imports_of(name)}]
    assert set(users) <= {"drgs/reconstruct/capture/load_views/unpickle_cameras.py"}


def test_nothing_is_loaded_that_may_run_code():
    # Only of what may be one of them: to write all out again takes longer than to read the tree.
    calls = [(name, node) for name in PRODUCT for node in nodes(name) if isinstance(node, ast.Call)]
    for name, node in calls:
        if (node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")) not in ("eval", "exec", "system", "load"):
            continue
        called = ast.unparse(node.func)
        keywords = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        assert called not in ("eval", "exec", "os.system"), f"{name}:{node.lineno} calls {called}"
        if called == "torch.load":
            assert keywords.get("weights_only") == "True", f"{name}:{node.lineno}: torch.load without weights_only=True"
        if called in ("np.load", "numpy.load"):
            assert keywords.get("allow_pickle", "False") == "False", f"{name}:{node.lineno}: np.load with pickles"


def test_no_path_of_one_machine_is_in_the_tree():
    private = re.compile(r"(?<![\w.])/(?:root|home/\w+|Users/\w+|work|tmp/[a-z])/")
    texts = (".py", ".ts", ".md", ".toml", ".sh", ".h", ".json", ".css", ".html", ".yml")
    found = [name for name in FILES if (name.endswith(texts) or "." not in Path(name).name) and name != "web/package-lock.json"]
    assert [
        name for name in found if name != "tests/test_architecture.py" and private.search((ROOT / name).read_text(errors="replace"))
    ] == []


@pytest.mark.slow
def test_public_names_exist_and_are_imported_late():
    program = "import sys, drgs; bad = {'torch', 'numpy'} & set(sys.modules); [getattr(drgs, n) for n in drgs.__all__]; sys.exit(sorted(bad) or None)"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=PATIENCE_SECONDS)
    assert result.returncode == 0, result.stderr


Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
PLAIN_DECORATORS = re.compile(r"(wp\.\w+|dataclass|cache|lru_cache|contextmanager|asynccontextmanager|torch\.no_grad)\b")
"""Those that do not register what they decorate anywhere; others (`app.command`, `router.get`) use it."""
A_NAME = re.compile(r"[\w.:]+((, | \| |\[)[\w.:]+\]*)*")
"""A string that may name something: an annotation in quotes, `package.module:name`, the argument of `getattr`."""


@cache
def used_names(name: str) -> set[str]:
    """Names that a file's code reads, and a little more. Neither imports, `__all__`, nor what a definition says of itself are uses."""
    found: set[str] = set()

    def visit(node: ast.AST, inside: frozenset[str]) -> None:
        names: list[str] = []
        if isinstance(node, Definition):
            inside |= {node.name}
        elif isinstance(node, ast.Assign) and any(isinstance(target, ast.Name) and target.id == "__all__" for target in node.targets):
            return
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load):
            names = [node.id]
        elif isinstance(node, ast.Attribute):
            names = [node.attr]
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and A_NAME.fullmatch(node.value):
            names = re.findall(r"\w+", node.value)
        found.update(name for name in names if name not in inside)
        # As ast.iter_child_nodes does, in half of the time; contexts and operators hold nothing.
        for field in node._fields:
            child = getattr(node, field, None)
            for one in child if isinstance(child, list) else (child,):
                if isinstance(one, ast.AST) and one._fields:
                    visit(one, inside)

    visit(syntax(name), frozenset())
    return found


def defined_names(tree: ast.Module) -> Iterator[str]:
    """Functions, classes and constants of a module that nothing registers."""
    for node in tree.body:
        if isinstance(node, Definition):
            if not node.name.startswith("__") and all(PLAIN_DECORATORS.match(ast.unparse(decorator)) for decorator in node.decorator_list):
                yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (target.id for target in targets if isinstance(target, ast.Name) and not target.id.startswith("__"))


def unused(definitions: list[str], users: list[str], public: set[str]) -> list[str]:
    """`file: name` of what is defined in one list of files and read in none of the other."""
    used = public.union(*map(used_names, users))
    return [f"{name}: {defined}" for name in definitions for defined in defined_names(syntax(name)) if defined not in used]


def test_no_name_is_there_for_tests_only():
    import drgs

    definitions = [name for name in PRODUCT if not name.startswith("drgs/reference/") and "/migrations/" not in name]
    users = [name for name in PYTHON if not name.startswith("tests/")]
    assert unused(definitions, users, set(drgs.__all__)) == []


def test_every_twin_is_compared_with():
    twins = [name for name in PRODUCT if name.startswith("drgs/reference/")]
    assert unused(twins, [*twins, *(name for name in PYTHON if name.startswith(("tests/", "benchmarks/")))], set()) == []


MANY_LINES, MANY_ARGUMENTS = 80, 12


def large_functions(name: str) -> Iterator[str]:
    """Functions beyond the limits that do not say why, in a comment or docstring of theirs: "Long because …", "Many arguments because …"."""
    lines = (ROOT / name).read_text().splitlines()
    for node in nodes(name):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        first = min(node.lineno, *(decorator.lineno for decorator in node.decorator_list)) if node.decorator_list else node.lineno
        text = "\n".join(lines[max(first - 2, 0) : node.end_lineno])  # a comment right above belongs to it
        length = (node.end_lineno or node.lineno) + 1 - node.lineno
        taken = node.args
        count = len(
            [
                a
                for a in (*taken.posonlyargs, *taken.args, *taken.kwonlyargs, taken.vararg, taken.kwarg)
                if a and a.arg not in ("self", "cls")
            ]
        )
        if length > MANY_LINES and "Long because " not in text:
            yield f"{name}: {node.name} has {length} lines"
        if count > MANY_ARGUMENTS and "Many arguments because " not in text:
            yield f"{name}: {node.name} takes {count} arguments"


def test_large_functions_say_why():
    large = [found for name in PYTHON if not name.startswith("tests/") for found in large_functions(name)]
    assert large == []
