"""Variants of a preset, the rows of an ablation, and what is kept when it is killed."""

import json
from pathlib import Path

import pytest
import trimesh

from benchmarks.builds.build_process import built_asset, read_events
from benchmarks.builds.build_variant import variant_command
from benchmarks.builds.fit_curves import curves_of, write_curves
from benchmarks.builds.variants import Variant, apply_overrides, read_variants
from benchmarks.reconstruct.ablate import main, main_figures, main_table, read_rows, run_rows, write_reached
from benchmarks.scenes.bench_scene import BenchScene
from drgs.reconstruct.presets import PRESETS
from drgs.scene.asset import Asset, load_asset, save_asset
from tests.reconstruct.tiny_capture import FEW_VIEWS, SPHERE_CENTER, SPHERE_RADIUS, sphere_views, write_nerf_synthetic, write_nerfstudio
from tests.render.closed_form_scenes import constant_sky, mesh_of

TINY = {
    "points": 300,
    "image_side": 48,
    "fit.iterations": 4,
    "fit.densify.budget": 400,
    "mesh.resolution": 32,
    "mesh.face_limit": 500,
    "surface.passes": 1,
    "surface.surface.steps_a_round": 2,
    "materials.iterations": 2,
    "materials.points_a_step": 32,
}


def test_overrides_reach_nested_settings_and_nothing_else() -> None:
    fast = PRESETS["fast"]
    changed = apply_overrides(fast, {"fit.densify.budget": 60_000, "materials.samples.cosine": 128, "fit.rates.centers": 1})
    assert (changed.fit.densify.budget, changed.materials.samples.cosine, changed.fit.rates.centers) == (60_000, 128, 1.0)
    back = {
        "fit.densify.budget": fast.fit.densify.budget,
        "materials.samples.cosine": fast.materials.samples.cosine,
        "fit.rates.centers": fast.fit.rates.centers,
    }
    assert apply_overrides(changed, back) == fast
    assert apply_overrides(fast, {"mesh.voxel_size": 0.01}).mesh.voxel_size == 0.01  # None before


def test_variants_may_begin_with_presets_of_their_own() -> None:
    presets = read_variants([str(Path(__file__).parents[3] / "benchmarks/presets.toml")])
    assert [(variant.name, variant.preset) for variant in presets] == [
        ("draft", "draft"), ("fast", "fast"), ("fast_longer", "fast"), ("full_shorter", "full"), ("full", "full"),
    ]  # fmt: skip
    for variant in presets:
        assert variant.preset is not None
        apply_overrides(PRESETS[variant.preset], variant.overrides)
    assert read_variants(["short:preset=full,surface.passes=6"]) == [Variant("short", {"surface.passes": 6}, "full")]
    with pytest.raises(ValueError, match="begins with the preset 'ful'; expected one of draft, fast, full"):
        read_variants(["short:preset=ful"])


def test_what_builds_reached_is_drawn_over_the_time_they_took(tmp_path: Path) -> None:
    rows = [
        {"scene": "ball", "variant": name, "seed": 0, "build": {"cpu_seconds": seconds}, "figures": {"views": {"mean": {"psnr": psnr}}}}
        for name, seconds, psnr in (("slow", 600.0, 31.0), ("quick", 60.0, 28.0))
    ]
    write_reached(tmp_path, rows)
    drawn = (tmp_path / "reached_ball.svg").read_text()
    assert "views dB" in drawn and "relit dB" not in drawn and "processor minutes" in drawn


@pytest.mark.parametrize(
    ("path", "value", "sentence"),
    [
        ("fit.densify.budgets", 1, "DensifySettings has no 'budgets'; it has every, start, stop"),
        ("fits.iterations", 1, "Preset has no 'fits'; it has points, image_side, fit"),
        ("fit.iterations", "many", f"'many' is no int; now it is {PRESETS['fast'].fit.iterations}"),
        ("fit.iterations", 1.5, "1.5 is no int"),
        ("fit.iterations", True, "True is no int"),
        ("fit.densify", 3, "is a DensifySettings; expected a path into it: fit.densify.every"),
        ("fit.iterations.half", 3, f"iterations is {PRESETS['fast'].fit.iterations}, a value"),
    ],
)
def test_a_wrong_override_is_one_sentence(path: str, value: object, sentence: str) -> None:
    with pytest.raises(ValueError, match=path) as raised:
        apply_overrides(PRESETS["fast"], {path: value})
    assert sentence in str(raised.value)


def test_variants_come_from_words_and_files(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps({"wide": {"mesh.truncation_voxels": 6}, "same": {}}))
    (tmp_path / "b.toml").write_text("[long]\nfit.iterations = 2000\nfit.densify.budget = 5\n")
    words = ["base", "many:fit.densify.budget=60000,materials.indirect=surfels", str(tmp_path / "a.json"), str(tmp_path / "b.toml")]
    assert read_variants(words) == [
        Variant("base"),
        Variant("many", {"fit.densify.budget": 60_000, "materials.indirect": "surfels"}),
        Variant("wide", {"mesh.truncation_voxels": 6}),
        Variant("same"),
        Variant("long", {"fit.iterations": 2000, "fit.densify.budget": 5}),
    ]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["other"], "'other' is no variant"),
        (["a:fit.iterations"], "sets nothing"),
        (["base", "base:points=3"], "given twice"),
        (["../a:points=3"], "names a folder"),
        (["none.json"], "not a readable file"),
    ],
)
def test_words_that_are_no_variants_are_refused(words: list[str], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        read_variants(words)


def test_a_wrong_path_is_refused_before_anything_is_built(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="has no 'budgets'"):
        main(["--variants", "a:fit.densify.budgets=3", "--scenes", str(tmp_path), "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()


def scene(name: str) -> BenchScene:
    return BenchScene(Path(name), name, None, (), ())


def test_a_finished_row_is_not_run_again_and_a_failed_one_is(tmp_path: Path) -> None:
    variants, scenes, runs = [Variant("base"), Variant("many", {"points": 3})], [scene("cup"), scene("box")], []
    failing = {"box/many/seed_0"}

    def run(one: BenchScene, variant: Variant, seed: int, work: Path) -> dict:
        name = str(work.relative_to(tmp_path))
        runs.append(name)
        if name in failing:
            raise ValueError("the build ended with exit code 1")
        return {"figures": {"views": {"psnr": 30.0 + seed}}}

    rows = run_rows(variants, scenes, "fast", 1, tmp_path, run)
    assert len(rows) == 3 and len(runs) == 4
    assert json.loads((tmp_path / "failed.json").read_text()) == {"box/many/seed_0": "the build ended with exit code 1"}
    text = (tmp_path / "rows.jsonl").read_text()
    (tmp_path / "rows.jsonl").write_text(text + '{"scene": "box", "var')  # killed while it wrote
    failing.clear()
    assert [row["scene"] + row["variant"] for row in run_rows(variants, scenes, "fast", 1, tmp_path, run)] == [
        "cupbase", "cupmany", "boxbase", "boxmany"
    ]  # fmt: skip
    assert runs[4:] == ["box/many/seed_0"] and len(read_rows(tmp_path)) == 4
    assert len(run_rows(variants, scenes, "fast", 2, tmp_path, run)) == 8 and len(runs) == 9


def test_a_row_of_other_settings_is_not_taken_for_this_one(tmp_path: Path) -> None:
    def run(*_: object) -> dict:
        return {}

    run_rows([Variant("a", {"points": 3})], [scene("cup")], "fast", 1, tmp_path, run)
    with pytest.raises(ValueError, match="rename it"):
        run_rows([Variant("a", {"points": 4})], [scene("cup")], "fast", 1, tmp_path, run)
    with pytest.raises(ValueError, match="rename it"):
        run_rows([Variant("a", {"points": 3})], [scene("cup")], "full", 1, tmp_path, run)


def row(variant: str, seed: int, psnr: float, seconds: float) -> dict:
    relight = {"dawn": {"psnr": 1.0, "psnr_scaled": psnr - 3}, "noon": {"psnr": 1.0, "psnr_scaled": psnr - 4}}
    build = {"seconds": seconds, "seconds_per_stage": {"fit": 1.0}, "peak_memory_mib": 1500, "resumed": False}
    figures = {"views": {"psnr": psnr, "ssim": 0.9}, "relight": relight, "seconds": {"test": 1.0}}
    return {"scene": "cup", "variant": variant, "seed": seed, "build": build, "figures": figures, "mesh": {"watertight": True}}


def test_main_figures_are_means_over_lights_and_the_whole_builds_seconds() -> None:
    assert main_figures(row("base", 0, 30.0, 200.0)) == {
        "views dB": 30.0, "SSIM": 0.9, "relit dB": 26.5, "seconds": 200.0, "MiB": 1500.0
    }  # fmt: skip


def test_the_table_brackets_what_the_spread_of_seeds_may_explain() -> None:
    rows = [row("base", 0, 30.0, 200), row("base", 1, 30.2, 202), row("many", 0, 31.0, 203), row("many", 1, 31.1, 205)]
    values, _, differences = main_table(rows, ["base", "many"]).split("\n\n")
    assert "| cup | base | 30.10 ±0.10 |" in values and "| cup | many | 31.05 ±0.05 |" in values
    assert "| cup | many | +0.95 |" in differences and "| (+3) |" in differences
    one = main_table([rows[0]], ["base"])
    assert "±" not in one and "Against" not in one


def test_a_build_that_went_on_is_marked() -> None:
    killed = row("base", 0, 30.0, 200)
    killed["build"]["resumed"] = True
    assert "| cup | base* |" in main_table([killed], ["base"])


EVENTS = [
    {"stage": "read", "iteration": 0, "psnr": None, "message": "reading", "elapsed_seconds": 1.0},
    {"stage": "fit", "iteration": 10, "psnr": 20.0, "message": "300 surfels", "elapsed_seconds": 60.0},
    {"stage": "fit", "iteration": 20, "psnr": 22.0, "message": "400 surfels", "elapsed_seconds": 120.0},
    {"stage": "materials", "iteration": 5, "psnr": 21.0, "message": "materials and light", "elapsed_seconds": 150.0},
    {"stage": "materials", "iteration": 10, "psnr": 23.0, "message": "materials and light", "elapsed_seconds": 180.0},
]


def test_curves_follow_the_progress_of_each_stage(tmp_path: Path) -> None:
    fit, materials = curves_of("base", EVENTS, "psnr", "minutes")
    assert (fit.name, fit.points[0], fit.points[-1]) == ("base", (1.0, 20.0), (2.0, 22.0))
    assert (materials.name, materials.points[-1]) == ("base (materials)", (3.0, 23.0))
    (surfels,) = curves_of("base", EVENTS, "surfels", "iterations")
    assert surfels.points[-1] == (20, 400.0)
    written = write_curves(tmp_path, {"cup": {"base": EVENTS}})
    assert sorted(path.name for path in written) == [
        f"cup_{what}_{over}.svg" for what in ("psnr", "surfels") for over in ("iterations", "minutes")
    ]
    assert all(path.read_text().startswith("<svg") and ">base<" in path.read_text() for path in written)


def test_rows_tables_and_curves_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The whole way but for the build, of which a ball too small or too large is the result."""
    source = write_nerfstudio(tmp_path / "mug")
    built = []

    def ball(_command: list[str], work: Path, what: dict) -> dict:
        built.append(what)
        work.mkdir(parents=True)
        shape = trimesh.creation.icosphere(3, SPHERE_RADIUS * what["overrides"].get("points", 95) / 100)
        shape.apply_translation(SPHERE_CENTER)
        save_asset(Asset(None, mesh_of(shape, 0.5, 0.5, 0.0), None, constant_sky()), work / "asset")
        (work / "progress.jsonl").write_text("".join(json.dumps(event) + "\n" for event in EVENTS))
        return {"seconds": 1.0, "seconds_per_stage": {}, "peak_memory_mib": 1, "resumed": False}

    monkeypatch.setattr("benchmarks.reconstruct.ablate.built_asset", ball)
    words = ["--variants", "base", "large:points=110", "--scenes", str(source), "--out", str(tmp_path / "out")]
    more = ["--preset", "draft", "--parts", "outlines", "mesh", "--json"]
    main([*words, *more])
    document = json.loads(capsys.readouterr().out)
    base, large = (row["outlines"]["mesh"]["signed_pixels"] for row in document["rows"])
    assert base < -0.3 and large > 0.6 and not document["failed"]
    assert document["rows"][0]["left_out"] == {"mesh": "mug has no gt_mesh.ply"}
    table = (tmp_path / "out" / "table.md").read_text()
    assert "| scene | variant | outline px | seconds |" in table.replace(" surfels |", "") and "Against base:" in table
    assert len(list((tmp_path / "out" / "curves").glob("mug_*.svg"))) == 4
    main([*words, *more])
    assert json.loads(capsys.readouterr().out) == document and len(built) == 2


@pytest.mark.slow
def test_a_variant_is_built_in_its_own_process_once(tmp_path: Path) -> None:
    capture, work = write_nerf_synthetic(tmp_path / "capture", sphere_views(FEW_VIEWS, square=True)), tmp_path / "work"
    command = variant_command(capture, work / "asset", "draft", "tiny", TINY, 0, "cpu")
    what = {"preset": "draft", "overrides": TINY, "seed": 0}
    built = built_asset(command, work, what)
    provenance = load_asset(work / "asset").provenance
    assert provenance["preset"] == "draft+tiny" and not built["resumed"]
    assert set(built["seconds_per_stage"]) == set(provenance["seconds"]) and built["peak_memory_mib"] > 100
    events = read_events(work / "progress.jsonl")
    assert {"fit", "materials"} <= {event["stage"] for event in events} and events[-1]["elapsed_seconds"] <= built["seconds"]
    assert built_asset(["-c", "raise SystemExit(3)"], work, what) == built  # finished: nothing runs
    with pytest.raises(ValueError, match="choose another --out"):
        built_asset(command, work, what | {"seed": 1})
    with pytest.raises(ValueError, match="exit code 3"):
        built_asset(["-c", "raise SystemExit(3)"], tmp_path / "other", what)
