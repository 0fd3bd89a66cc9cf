"""The tree keeps its shape: imports go one way, and names, devices and dangers stay where they belong."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LAYERS = ("drgs.maths", "drgs.exchange", "drgs.scene", "drgs.deform", "drgs.render", "drgs.build", "worker", "server")
"""Each may import those before it."""
TOP_FILES = {"drgs/__init__.py", "drgs/cli.py", "drgs/cli_progress.py", "drgs/metrics.py", "drgs/client.py", "drgs/warp_torch.py"}
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


def syntax(name: str) -> ast.Module:
    return ast.parse((ROOT / name).read_text(), name)


def imports(tree: ast.AST) -> set[str]:
    """Dotted names that the code imports, wherever in it."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {node.module}
    return found


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


def layer(dotted: str) -> int | None:
    """Place in LAYERS of a module."""
    return next((k for k, name in enumerate(LAYERS) if dotted == name or dotted.startswith(name + ".")), None)


@pytest.mark.parametrize("name", [name for name in PRODUCT if layer(name.replace("/", ".")) is not None])
def test_imports_go_one_way(name: str):
    own = layer(name.removesuffix(".py").replace("/", "."))
    assert own is not None
    upwards = {found for found in imports(syntax(name)) if (layer(found) or 0) > own}
    assert not upwards, f"{name} lies in {LAYERS[own]} and imports {sorted(upwards)}"


def test_maths_imports_nothing_else_of_drgs():
    for name in (name for name in PRODUCT if name.startswith("drgs/maths/")):
        found = {dotted for dotted in imports(syntax(name)) if dotted.startswith("drgs.") and not dotted.startswith("drgs.maths")}
        assert not found, f"{name} imports {sorted(found)}"


def test_every_file_of_drgs_belongs_to_a_layer():
    strays = [
        name
        for name in PRODUCT
        if name.startswith("drgs/") and layer(name.replace("/", ".")) is None and not name.startswith("drgs/reference/")
    ]
    assert set(strays) <= TOP_FILES


def test_the_reference_is_for_tests_and_benchmarks_only():
    users = [
        name
        for name in PRODUCT
        if not name.startswith("drgs/reference/") and any(d.startswith("drgs.reference") for d in imports(syntax(name)))
    ]
    assert users == []


def test_server_and_worker_import_no_torch_at_module_level():
    heavy = ("torch", "warp")
    for name in (name for name in PRODUCT if name.startswith(("server/", "worker/"))):
        found = {dotted for dotted in module_level_imports(syntax(name)) if dotted.split(".")[0] in heavy}
        assert not found, f"{name} imports {sorted(found)} when it is imported"


@pytest.mark.parametrize("module", ["server.app", "worker.run"])
def test_importing_a_service_does_not_bring_torch_along(module: str):
    program = f"import sys, {module}; sys.exit(sorted({{'torch', 'warp'}} & set(sys.modules)) or None)"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr


def test_names_say_something():
    empty = re.compile(r"(^|/)(utils?|helpers?|common|misc)(\.[a-z]+)?(/|$)")
    assert [name for name in FILES if empty.search(name)] == []


def test_devices_are_those_of_the_inputs():
    # `device_from_name` is where a user's word becomes a device; the command line has that word as a choice.
    allowed = {"drgs/warp_torch.py", "drgs/cli.py"}
    named = [
        name
        for name in PRODUCT
        if name.startswith("drgs/") and name not in allowed and re.search(r"""["']cuda(:\d)?["']""", (ROOT / name).read_text())
    ]
    assert named == []


def test_pickle_is_met_only_by_the_restricted_reader():
    dangerous = {"pickle", "cPickle", "dill", "joblib", "shelve", "marshal"}
    users = [name for name in PRODUCT if dangerous & {dotted.split(".")[0] for dotted in imports(syntax(name))}]
    assert set(users) <= {"drgs/build/load_views/unpickle_cameras.py"}


@pytest.mark.parametrize("name", PRODUCT)
def test_nothing_is_loaded_that_may_run_code(name: str):
    for node in ast.walk(syntax(name)):
        if not isinstance(node, ast.Call):
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


def test_public_names_exist_and_are_imported_late():
    program = "import sys, drgs; bad = {'torch', 'numpy'} & set(sys.modules); [getattr(drgs, n) for n in drgs.__all__]; sys.exit(sorted(bad) or None)"
    result = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr
