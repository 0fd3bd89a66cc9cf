"""Splats that the browser compresses: saved from the export panel with the edits, and read again by splat-transform on Node."""

import math
import re
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from playwright.sync_api import Browser, Page, Route, expect

from drgs.exchange.export_formats import FILE_KINDS, SPLAT_KINDS
from drgs.exchange.ply import parse_ply
from drgs.maths.frames import quat_wxyz_from_rotation, rotation_from_quat_wxyz
from drgs.scene.asset import Asset, save_asset
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs_server.client import Client
from tests.web.browser import RunningServer
from tests.web.conftest import Viewer, shown_page

SPLATS = 600
"""More than the 512 harmonics that the palette of so small a SOG has, so that it has to choose."""
SH_0 = 0.28209479177387814


def splat_ball() -> Asset:
    """A ball of radius 0.5 of surfels of several sizes, shades and opacities, and its mesh."""
    shape = trimesh.creation.icosphere(2, 0.5)
    vertices = torch.tensor(np.asarray(shape.vertices), dtype=torch.float32)
    count = len(vertices)
    mesh = TriangleMesh(
        vertices, torch.tensor(np.asarray(shape.faces), dtype=torch.int32), 2 * vertices, torch.full((count, 3), 0.5),
        torch.full((count,), 0.5), torch.zeros(count),
    )  # fmt: skip
    random = torch.Generator().manual_seed(0)
    normals = torch.nn.functional.normalize(torch.randn(SPLATS, 3, generator=random), dim=-1)
    tangents = torch.nn.functional.normalize(torch.linalg.cross(normals, torch.randn(SPLATS, 3, generator=random)), dim=-1)
    rotations = torch.stack([tangents, torch.linalg.cross(normals, tangents), normals], -1)
    sh = 0.05 * torch.randn(SPLATS, 16, 3, generator=random)
    sh[:, 0] = normals
    gaussians = Gaussians(
        0.5 * normals, torch.rand(SPLATS, 2, generator=random) - 4, quat_wxyz_from_rotation(rotations), torch.randn(SPLATS, generator=random),
        sh, torch.full((SPLATS, 3), 0.5), torch.full((SPLATS,), 0.5), torch.zeros(SPLATS),
    )  # fmt: skip
    return Asset(gaussians, mesh, None, Environment(torch.ones(4, 8, 3)))


@pytest.fixture(scope="module")
def splats(server: RunningServer, browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Viewer]:
    """The page with such a ball open, at the export panel, twisted."""
    folder = tmp_path_factory.mktemp("splats")
    save_asset(splat_ball(), folder / "asset")
    with zipfile.ZipFile(folder / "splats.zip", "w") as package:
        for path in (folder / "asset").iterdir():
            package.write(path, path.name)
    with Client(server.address, token=server.token) as client:
        asset = client.upload_asset(folder / "splats.zip").id
    with shown_page(server, browser, asset) as viewer:
        expect(viewer.page.get_by_role("heading", name="splats", exact=True)).to_be_visible()
        viewer.open_tab("Export")
        viewer.append_edit({"op": "deform", "map": {"type": "twist", "rate": 2.0}})
        expect(viewer.page.get_by_role("switch", name="With this session’s edits")).to_be_visible()
        yield viewer


@pytest.fixture(scope="module")
def given(splats: Viewer, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The 3DGS PLY of the twisted ball, which the others are made of."""
    return saved(splats.page, FILE_KINDS["ply3"].title, tmp_path_factory.mktemp("given"))


def serve(page: Page, files: dict[str, bytes]) -> None:
    """Give these files by format, instead of having the server write them, which takes a process each; no HTML, and thousands of bytes of the rest."""

    def answer(route: Route) -> None:
        format = re.findall(r"format=(\w+)", route.request.url)[0]
        if format == "html":
            route.fulfill(status=422, json={"detail": "No page can be made of it."})
        else:
            route.fulfill(body=files.get(format, b"x" * 1000 * (1 + list(FILE_KINDS).index(format))))  # type: ignore[arg-type]

    page.route("**/export?*", answer)


def saved(page: Page, title: str, folder: Path) -> Path:
    """The file that the button of this title gives, under the name that the page gives it."""
    with page.expect_download() as download:
        page.get_by_role("link", name=title).click()
    path = folder / download.value.suggested_filename
    download.value.save_as(path)
    return path


def columns(path: Path) -> dict[str, np.ndarray]:
    """Of the splats of a PLY in float64: `centers` (splat, 3), `log_scales` (splat, 3), `rotations` (splat, 3, 3), `opacities` (splat,), `colors`
    (splat, 3) and `harmonics` (splat, 45)."""
    read = parse_ply(path.read_bytes()).elements["vertex"].scalars

    def stack(*names: str) -> np.ndarray:
        return np.stack([read[name] for name in names], -1).astype(float)

    return {
        "centers": stack("x", "y", "z"),
        "log_scales": stack("scale_0", "scale_1", "scale_2"),
        "rotations": rotation_from_quat_wxyz(torch.from_numpy(stack(*(f"rot_{k}" for k in range(4))))).numpy(),
        "opacities": 1 / (1 + np.exp(-stack("opacity")[:, 0])),
        "colors": 0.5 + SH_0 * stack(*(f"f_dc_{k}" for k in range(3))),
        "harmonics": stack(*(f"f_rest_{k}" for k in range(45))),
    }


BOUNDS = {
    "compressed": {"centers": 0.001, "log_scales": 0.006, "rotations": 0.005, "opacities": 0.003, "colors": 0.004, "harmonics": 0.04},
    "sog": {"centers": 0.00005, "log_scales": 0.02, "rotations": 0.03, "opacities": 0.005, "colors": 0.005, "harmonics": 0.2},
}
"""Largest differences: places of a ball 1 wide, scales by their logarithm, rotations by entries of their matrix, opacities and colours of 0..1, harmonics as they are."""


@pytest.mark.parametrize("format", SPLAT_KINDS)
def test_the_browser_writes_what_splat_transform_reads_as_the_ply_of_the_edited_object(
    splats: Viewer, given: Path, run_node: Callable[..., str], tmp_path: Path, format: str
) -> None:
    kind = SPLAT_KINDS[format]  # type: ignore[index]
    expected = columns(given)
    made = saved(splats.page, kind.title, tmp_path)
    assert made.name == f"splats{kind.suffix}"
    expect(splats.page.get_by_role("link", name=f"{kind.title} {math.ceil(made.stat().st_size / 1e3)} kB")).to_be_visible()
    run_node("node_modules/@playcanvas/splat-transform/bin/cli.mjs", "--quiet", "--overwrite", made, tmp_path / "back.ply")
    found = columns(tmp_path / "back.ply")
    as_captured = splat_ball().gaussians
    assert as_captured is not None
    assert len(found["centers"]) == len(expected["centers"]) == SPLATS
    assert np.abs(expected["centers"] - as_captured.centers.numpy()).max() > 0.1, "twisted"
    nearest = np.linalg.norm(found["centers"][None] - expected["centers"][:, None], axis=-1).argmin(1)
    assert len(set(nearest)) == SPLATS, "they are in another order"
    off = {name: np.abs(found[name][nearest] - values).max() for name, values in expected.items()}
    print(format, {name: f"{value:.5f}" for name, value in off.items()})
    assert all(off[name] < bound for name, bound in BOUNDS[format].items()), off


def test_what_compresses_is_loaded_when_it_is_first_asked_for_and_a_file_is_not_made_twice(
    splats: Viewer, given: Path, tmp_path: Path
) -> None:
    loaded: list[str] = []
    page = splats.page
    page.on("request", lambda request: loaded.append(request.url))
    page.reload()
    splats.open_tab("Export")
    expect(page.get_by_role("switch", name="With this session’s edits")).to_be_visible()
    serve(page, {"ply3": given.read_bytes()})
    assert not [url for url in loaded if re.search(r"worker|\.wasm", url)]
    first = saved(page, SPLAT_KINDS["compressed"].title, tmp_path).read_bytes()
    assert [url for url in loaded if "/assets/worker" in url]
    loaded.clear()
    assert saved(page, SPLAT_KINDS["compressed"].title, tmp_path).read_bytes() == first and loaded == []
    page.unroute("**/export?*")


@pytest.mark.parametrize("missing", ["assets/worker", ".wasm"])
def test_a_file_that_cannot_be_compressed_says_so_in_one_sentence(splats: Viewer, given: Path, missing: str) -> None:
    page = splats.page
    serve(page, {"ply3": given.read_bytes()})
    page.route(re.compile(re.escape(missing)), lambda route: route.abort())
    page.get_by_role("link", name=SPLAT_KINDS["sog"].title).click()
    notices = page.get_by_role("log").get_by_text("`drgs export` writes it where Node is installed.")
    expect(notices).to_have_count(1)
    page.get_by_role("log").get_by_role("button", name="Dismiss").click()
    page.unroute(re.compile(re.escape(missing)))
    page.unroute("**/export?*")
    splats.complaints.clear()  # the browser's own lines about what is missing
    expect(page.get_by_role("button", name="Compare sizes")).to_be_enabled()


def test_sizes_are_shown_beside_each_other(splats: Viewer, given: Path) -> None:
    page = splats.page
    serve(page, {"ply3": given.read_bytes()})
    page.get_by_role("button", name="Compare sizes").click()
    expect(page.get_by_role("link", name=re.compile(r"Gaussians \(SOG\) \d+ kB"))).to_be_visible()
    expect(page.get_by_role("link", name=re.compile(r"Gaussians \(compressed PLY\) \d+ kB"))).to_be_visible()
    for place, (format, kind) in enumerate(FILE_KINDS.items()):
        size = "none" if format == "html" else f"{math.ceil(given.stat().st_size / 1e3)} kB" if format == "ply3" else f"{1 + place} kB"
        expect(page.get_by_role("link", name=re.compile(f"{re.escape(kind.title)} {size}"))).to_be_visible()
    expect(page.get_by_title("No page can be made of it.")).to_be_visible()
    expect(page.get_by_role("button", name="Compare sizes")).to_be_enabled()
    page.unroute("**/export?*")
    splats.complaints[:] = [text for text in splats.complaints if "422" not in text]  # the browser's own line


def test_nothing_was_against_the_policy_and_no_error_logged(splats: Viewer) -> None:
    assert splats.complaints == []
