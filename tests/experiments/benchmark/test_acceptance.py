"""What decides whether the default is good enough, from results made up."""

from __future__ import annotations

import dataclasses

import pytest
from made_results import all_results, benchmark, folder_of, result

from benchmarks.acceptance import Command, Threshold, thresholds, worst_gap
from ssa_nerfstudio.experiments.benchmark.report.study import studies
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Part, SceneEntry
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan

YARD = SceneEntry("yard", artifact="finger", clean="clean", mask="finger.png")
ROAD = SceneEntry("road", artifact="bonnet", mask="bonnet.png", clean_tests=False)
EVERYTHING = Part(methods=("3dgs", "default", "overlay-on", "paper"), effects=("none",))


def judged(results, densification: str = "adc") -> dict[str, tuple[float, bool]]:
    return {t.what: (round(t.value, 2), t.met) for study in studies(results) for t in thresholds(study, densification)}


def test_a_missed_threshold_is_marked():
    results = all_results()
    for k, r in enumerate(results):
        if (r.run.scene, r.run.effect, r.run.method, r.run.densification) == ("barn", "mud", "default", "adc"):
            results[k] = dataclasses.replace(r, metrics={**r.metrics, "psnr": 20.0})
    better = "default - better of paper's rule and oracle"
    found = judged(results)
    assert found[f"barn, mud: {better}"] == (-0.35, False)
    assert found[f"attic, mud: {better}"] == (0.2, True)
    assert found[f"mean of {better}"] == (0.06, True)
    assert found["- mean color deviation, 0 to 255"] == (-5.0, False)
    assert judged(results, "mcmc")[f"mean of {better}"] == (0.2, True)


def test_a_capture_with_clean_counterparts_is_compared_with_training_on_them():
    found = judged([result(run) for run in plan(benchmark(scenes=(YARD,), parts=(EVERYTHING,)))])
    assert found["yard, finger: default - the same photos without it"] == (4.5, True)
    assert found["yard, clean: overlay on - off"] == (4.4, True)


def test_a_capture_without_clean_views_is_judged_outside_its_mask_and_by_its_matte():
    results = []
    for run in plan(benchmark(scenes=(ROAD,), parts=(EVERYTHING,))):
        mattes = {"matte_inside": 0.9, "matte_outside": 0.1, "matte_upper_third": 0.03}
        made = result(run, artifact={} if run.method == "3dgs" else mattes)
        results.append(dataclasses.replace(made, metrics={**made.metrics, "outside_psnr": made.metrics["psnr"]}))
    assert judged(results) == {
        "road, bonnet: outside the mask, default - off": (4.5, True),
        "road, bonnet: mean matte inside": (0.9, True),
        "road, bonnet: - mean matte of the upper third": (-0.03, False),
    }


def test_one_view_far_below_all_others_is_seen():
    made = all_results()[0]
    views = {name: {"psnr": psnr} for name, psnr in (("a", 24.0), ("b", 9.0), ("c", 22.0), ("d", None))}
    assert worst_gap(dataclasses.replace(made, views=views)) == -13.0
    assert worst_gap(dataclasses.replace(made, views={"a": {"psnr": 24.0}})) is None


def test_the_script_ends_with_1_where_a_threshold_is_missed(tmp_path, capsys):
    folder_of(tmp_path, all_results())
    with pytest.raises(SystemExit) as ended:
        Command((tmp_path,)).run()
    assert ended.value.code == 1
    printed = capsys.readouterr().out
    assert "| - mean color deviation, 0 to 255 | -5.00 | -1.60 | **no** |" in printed
    assert printed.splitlines()[-1].endswith("are met.")


@pytest.mark.parametrize(("value", "met"), [(-0.31, False), (-0.3, True), (-0.29, True)])
def test_a_bar_is_met_at_its_value_and_not_below(value, met):
    bar = Threshold("default - oracle", value, -0.3)
    assert bar.met == met
    assert str(bar).endswith("| yes |" if met else "| **no** |")


def test_the_mean_over_artifacts_may_not_fall_below_the_reference():
    """Each artifact may lose 0.3 dB; all together may lose nothing."""
    results = all_results()
    for k, r in enumerate(results):
        psnr = r.metrics["psnr"]
        if r.run.method == "default" and r.run.effect != "none" and psnr is not None:
            results[k] = dataclasses.replace(r, metrics={**r.metrics, "psnr": psnr - 0.4})
    found = judged(results)
    better = "default - better of paper's rule and oracle"
    assert found[f"barn, mud: {better}"] == (-0.2, True)
    assert found[f"mean of {better}"] == (-0.2, False)
