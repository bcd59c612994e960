"""Reports from made-up results, whose every number can be worked out by hand."""

from __future__ import annotations

import dataclasses
import json
import re
from typing import Any

import pytest
from made_results import all_results, benchmark, folder_of, result
from PIL import Image

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.report import category_tables, detail_tables, difference_tables
from ssa_nerfstudio.experiments.benchmark.report import paper_tables as paper
from ssa_nerfstudio.experiments.benchmark.report.benchmark_report import report, store_plan
from ssa_nerfstudio.experiments.benchmark.report.study import studies
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import Part, SceneEntry
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan


def table(drawn) -> dict[tuple[str, ...], list[str]]:
    """Rows by their first cells, with bold marks removed."""
    rows = [[cell.replace("**", "") for cell in row] for row in drawn.rows]
    return {tuple(row[:3]): row for row in rows} | {(row[0],): row for row in rows}


def column(drawn, row: str, heading: str) -> str:
    return table(drawn)[(row,)][drawn.headings.index(heading)]


def test_a_category_is_the_mean_over_scenes_and_seeds_of_adc_and_mcmc():
    (study,) = studies(all_results())
    drawn = category_tables.results_by_category(study, with_paper=False)
    assert column(drawn, "Dashboard", "3DGS PSNR ↑") == "16.05 / 17.05"
    assert column(drawn, "Mean", "SSA, paper's rule PSNR ↑") == "20.05 / 21.05"
    assert column(drawn, "Clean (Ref)", "oracle overlay PSNR ↑") == "-"
    assert [row[0] for row in drawn.rows] == ["Clean (Ref)", "Dashboard", "Mud", "Mean"]
    bold = [cell for row in drawn.rows for cell in row if re.fullmatch(r"20.55 / \*\*21.55\*\*", cell)]
    assert len(bold) == 8  # the default is the best of every row, in mean and median
    assert column(drawn, "Mud", "SSA, default worst view") == "19.55 / 20.55"


def test_a_diverged_run_is_left_out_of_means_marked_and_counted(tmp_path):
    results = all_results()
    bad = next(
        k for k, r in enumerate(results) if (r.run.scene, r.run.effect, r.run.method) == ("attic", "mud", "3dgs")
    )
    results[bad] = dataclasses.replace(results[bad], status="diverged", reason="means of a Gaussian is not finite")
    results[bad] = dataclasses.replace(results[bad], metrics={}, views={}, seconds={})
    (study,) = studies(results)
    value = study.value("mud", "3dgs", "adc", "psnr")
    assert value is not None
    assert value.diverged == 1
    assert value.mean == pytest.approx((16.1 + 16.05) / 2)  # attic has only its second seed left
    assert column(category_tables.results_by_category(study, False), "Mud", "3DGS PSNR ↑").split(" / ")[0].endswith("†")
    folder_of(tmp_path, results)
    report([tmp_path], tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    assert "1 diverged" in text
    assert "means of a Gaussian is not finite" in text


def test_a_mean_over_too_few_scenes_says_so():
    results = [r for r in all_results() if not (r.run.scene == "barn" and r.run.method == "given")]
    (study,) = studies(results)
    cell = column(category_tables.results_by_category(study, False), "Mud", "oracle overlay PSNR ↑")
    assert cell == "20.35 (1/2) / 21.35 (1/2)"


def test_the_spread_over_seeds_is_their_standard_deviation():
    (study,) = studies(all_results())
    drawn = detail_tables.results_by_scene(study)
    rows = [row for row in drawn.rows if row[:2] == ["mud", "barn"]]
    assert [row[2] for row in rows] == ["mean", "median", "worst view"]
    assert "16.05 ± 0.07 / 17.05 ± 0.07" in rows[0]
    assert "15.05 ± 0.07 / 16.05 ± 0.07" in rows[2]


def test_a_bad_view_is_seen_beside_the_median_that_it_leaves():
    results = all_results()
    for r in results:
        bad = 8.0 if r.run.method == "default" else 20.0
        r.views.update({"bad.png": {"psnr": bad}, "good.png": {"psnr": 40.0}})
    (study,) = studies(results)
    drawn = category_tables.results_by_category(study, with_paper=False)
    assert column(drawn, "Mud", "SSA, default median") == "20.55 / 21.55"
    assert column(drawn, "Mud", "SSA, default worst view") == "8.00 / 8.00"
    paired = difference_tables.paired(study, "default")
    assert paired is not None
    assert paired.headings[3:6] == ["PSNR", "PSNR, median", "PSNR, worst"]
    row = next(row for row in paired.rows if row[:3] == ["minus 3DGS", "ADC", "Mud"])
    assert row[4:6] == ["+4.50", "-12.00"]


def test_captures_with_the_artifact_on_their_test_photos_are_judged_by_their_mask_alone(tmp_path):
    road = SceneEntry("road", artifact="bonnet", mask="bonnet.png", clean_tests=False)
    results = [result(run) for run in plan(benchmark(scenes=(*benchmark().scenes, road)))]
    for r in (r for r in results if r.run.scene == "road"):
        more = {"outside_psnr": 3.0, "composite_psnr": 2.0} if r.run.method != "3dgs" else {"outside_psnr": 3.0}
        for scores in (r.metrics, *r.views.values()):
            psnr = scores["psnr"]
            assert psnr is not None
            scores.update({name: psnr + gain for name, gain in more.items()})
        if r.run.method != "3dgs":
            r.artifact = {"matte_inside": 0.75, "matte_outside": 0.01, "matte_upper_third": 0.0}
    clean, marred = studies(results)
    assert "road" not in clean.scenes
    assert detail_tables.by_mask(clean) is None
    drawn = detail_tables.by_mask(marred)
    assert drawn is not None
    rows = {tuple(row[2:4]): row[4:] for row in drawn.rows}
    assert rows["3DGS", "ADC"] == ["19.05", "19.05", "18.05", "16.05", "16.05", "15.05", "", "", ""]
    learned = ["23.55", "23.55", "22.55", "22.55", "22.55", "21.55", "0.750", "0.010", "0.000"]
    assert rows["SSA, default", "ADC"] == learned
    baseline = Part(("desplat",), ("none",))
    (masked,) = (result(run) for run in plan(benchmark(scenes=(road,), parts=(baseline,))) if run.real)
    masked.metrics["outside_psnr"] = 21.0
    masked.artifact = {"matte_inside": 0.0, "matte_outside": 0.0, "matte_upper_third": 0.0}
    (alone,) = studies([masked])
    without = detail_tables.by_mask(alone)
    assert without is not None
    assert without.rows[0][-3:] == ["", "", ""]  # it learns no overlay
    report([folder_of(tmp_path, results)], tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    assert text.count("By a mask of the artifact") == 1
    assert "| outside: PSNR ↑ | median | worst view |" in text
    assert "## What this is made of" in text
    assert "| device | torch | gsplat | revision | runs |" in text
    assert "test photos with the artifact" in text


def test_scenes_whose_exposure_varies_are_shown_with_and_without_color_correction(tmp_path):
    dusk = SceneEntry("dusk", exposure=0.3)
    results = [result(run) for run in plan(benchmark(scenes=(*benchmark().scenes, dusk)))]
    for r in results:
        psnr: Any = r.metrics["psnr"]
        r.metrics |= {"cc_psnr": psnr + 5, "mean_color_deviation": 7.0}
        for view in r.views.values():
            own: Any = view["psnr"]
            view |= {"cc_psnr": own + 5, "mean_color_deviation": 7.0}
    (study,) = studies(results)
    drawn = detail_tables.by_exposure(study)
    assert drawn is not None
    assert {row[1] for row in drawn.rows} == {"dusk"}
    row = next(row for row in drawn.rows if row[0] == "mud" and row[2:4] == ["3DGS", "ADC"])
    assert float(row[5]) == pytest.approx(float(row[4]) + 5)
    assert row[6] == "7.00"
    (constant,) = studies(all_results())
    assert detail_tables.by_exposure(constant) is None


def test_differences_are_paired_by_view_and_seed():
    (study,) = studies(all_results())
    drawn = difference_tables.paired(study, "default")
    assert drawn is not None
    rows = {tuple(row[:3]): row[3] for row in drawn.rows}
    assert rows["minus 3DGS", "ADC", "Mud"] == "+4.50 [+4.50, +4.50]"
    assert rows["minus oracle overlay", "MCMC", "Mean"] == "+0.20 [+0.20, +0.20]"
    assert rows["minus SSA, paper's rule", "ADC", "Clean photos"] == "+0.50 [+0.50, +0.50]"


def test_ablation_and_sensitivity_are_the_papers_tables():
    (study,) = studies(all_results())
    drawn = category_tables.ablation(study, with_paper=False)
    assert drawn is not None
    assert column(drawn, "L_sparse + const. init", "PSNR ↑") == "19.05 / 20.05"
    assert column(drawn, "No regularization", "color deviation ↓") == "5.00 / 5.00"
    weights = category_tables.sensitivity(study, with_paper=False)
    assert weights is not None
    assert weights.rows[-1][:2] == ["Mean, the paper's rule", "20.05 / 21.05"]


def test_other_lengths_and_other_artifacts_are_tables_of_their_own():
    parts = (
        Part(methods=("3dgs",), effects=("none", "mud"), steps=700),
        Part(methods=("3dgs",), effects=("mud",), steps=700, effect_seed=1),
        Part(methods=("3dgs",), effects=("mud",), steps=3000),
    )
    found = studies(all_results(parts=parts))
    assert [(s.steps, s.effect_seed, len(s.results)) for s in found] == [(700, 0, 4), (700, 1, 4), (3000, 0, 2)]


def _paper_report(tmp_path, steps: int) -> str:
    methods = ("3dgs", "paper", "l1-0", "constant-start")
    part = Part(methods=methods, effects=("none", "mud"), densification=("adc", "mcmc"), steps=steps)
    made = benchmark(parts=(part,), protocol="paper")
    runs = plan(made)
    folder_of(tmp_path, [result(run) for run in runs])
    store_plan(tmp_path, "bench", made, runs)
    report([tmp_path], tmp_path / "report")
    return (tmp_path / "report" / "report.md").read_text()


def test_the_papers_figures_stand_beside_ours_where_the_protocol_is_the_same(tmp_path):
    assert "| 23.21 / 22.84 |  |  | 0.708 / 0.742" in _paper_report(tmp_path / "same", 30_000)
    assert "23.21" not in _paper_report(tmp_path / "shorter", 7000)


def test_the_papers_ablation_stands_beside_ours_with_its_color_deviation(tmp_path):
    assert "the paper, MCMC | 29.00 |  |  | 0.869 | 0.122 | 3.19 |" in _paper_report(tmp_path, 30_000)


def test_the_papers_baselines_stand_in_its_table_whether_they_were_run_or_not(tmp_path):
    text = _paper_report(tmp_path, 30_000)
    assert "RobustNeRF PSNR ↑" in text
    row = next(line for line in text.splitlines() if line.startswith("|   the paper | 23.21"))
    assert "| 23.40 / - |  |  | 0.700 / - | 0.231 / - | 23.32 / - |" in row


def test_tables_are_written_as_latex_with_metrics_below_their_methods(tmp_path):
    _paper_report(tmp_path, 30_000)
    text = (tmp_path / "report" / "report.tex").read_text()
    assert text.count(r"\begin{tabular}") == text.count(r"\end{table*}") > 5
    table = text[text.index(r"\caption{Results by category") :].split(r"\end{tabular}")[0]
    assert r" & \multicolumn{5}{c}{3DGS} & \multicolumn{5}{c}{SSA, paper's rule}" in table
    assert r"\cmidrule(lr){2-6}\cmidrule(lr){7-11}" in table
    assert r"Artifact & PSNR $\uparrow$ & median & worst view & SSIM $\uparrow$ & FLIP $\downarrow$ & PSNR" in table
    lines = [line for line in table.splitlines() if line.endswith(r" \\")]
    assert len({line.count(" & ") for line in lines[1:]}) == 1
    assert not re.search(r"[↑↓†±]|\*\*|(?<!\\)[%_#](?!\n)", table)


def test_the_papers_means_are_those_of_its_rows():
    for method in ("3dgs", "paper", "desplat", "robustnerf", "spotless-mlp", "difix3d"):
        for densification in ("adc", "mcmc") if method in ("3dgs", "paper") else ("adc",):
            rows = [
                paper.RESULTS[kind, method, densification] for kind in ("watermark", "ui", "dashboard", "rain", "mud")
            ]
            for number, tolerance in ((0, 0.002), (1, 0.001), (2, 0.001)):
                mean = sum(row[number] for row in rows) / 5
                assert mean == pytest.approx(paper.RESULTS["mean", method, densification][number], abs=tolerance)


def test_real_captures_are_the_papers_tables_of_methods_and_of_scenes(tmp_path):
    part = Part(methods=("3dgs", "paper", "constant-start"), steps=30_000)
    scenes = tuple(SceneEntry(name, artifact=name.split("_")[0]) for name in ("finger_hallway", "mud_kitchen"))
    made = benchmark(scenes=scenes, parts=(part,), protocol="paper")
    folder_of(tmp_path, [result(run) for run in plan(made)])
    store_plan(tmp_path, "bench", made, plan(made))
    report([tmp_path], tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    groups = [f"{name} {metric}" for name in ("Finger", "Mud", "Mean") for metric in ("PSNR ↑", "SSIM ↑", "FLIP ↓")]
    assert f"| Method | {' | '.join(groups)} |" in text
    assert "| 3DGS | 16.00 | 0.800 | 0.200 | 16.00 |" in text.replace("**", "")
    assert "|   the paper | 13.45 | 0.575 | 0.506 | 15.94 | 0.574 | 0.402 | 15.34 | 0.572 | 0.439 |" in text
    assert "| DeSplat | - | - | - | - | - | - | - | - | - |\n|   the paper | 13.75 |" in text
    assert "| Finger | finger_hallway | 16.00 | **0.800** | **0.200** | **20.00** |" in text
    assert "|   the paper |  | 18.30 | 0.750 | 0.336 | 19.70 | 0.791 | 0.299 | 19.50 | 0.783 | 0.302 | 19.47 |" in text
    assert text.count("Best of a column in bold") == 1
    tables = (tmp_path / "report" / "report.tex").read_text()
    assert r" & \multicolumn{3}{c}{Finger} & \multicolumn{3}{c}{Mud} & \multicolumn{3}{c}{Mean}" in tables
    assert r"\caption{Captured artifacts by scene" in tables


def test_the_papers_categories_are_the_means_of_its_scenes():
    for kind, method, densification in paper.REAL:
        chosen = [
            triple
            for (scene, of, _), triple in paper.REAL_BY_SCENE.items()
            if of == method and (kind == "mean" or scene.startswith(f"{kind}_"))
        ]
        assert len(chosen) == {"finger": 4, "mud": 7, "occlusion": 4, "mean": 15}[kind]
        for values, stated in zip(zip(*chosen, strict=True), paper.REAL[kind, method, densification], strict=True):
            assert sum(values) / len(values) == pytest.approx(stated, abs=0.011)


def test_what_is_missing_truncated_or_foreign_is_named_and_the_report_goes_on(tmp_path):
    results = all_results()
    folder_of(tmp_path, results[1:])
    store_plan(tmp_path, "bench", benchmark(), plan(benchmark()))
    whole = sorted((tmp_path / "results").glob("*.json"))
    whole[0].write_text(whole[0].read_text()[:100])
    (tmp_path / "results" / "foreign.json").write_text(json.dumps({"psnr": 1}))
    _, problems = report([tmp_path], tmp_path / "report")
    text = (tmp_path / "report" / "report.md").read_text()
    assert [whole[0].name in problems[0], "foreign.json" in problems[1]] == [True, True] or "foreign.json" in problems[
        0
    ]
    assert all(line in text for line in problems)
    assert f"missing are 2 of {len(results)} that were planned: " in text
    assert f"`{results[0].run.id}`" in text


def test_several_folders_are_added_up_without_copying(tmp_path):
    results = all_results()
    folder_of(tmp_path / "a", results[::2])
    folder_of(tmp_path / "b", results[1::2])
    report([tmp_path / "a", tmp_path / "b"], tmp_path / "report")
    report([folder_of(tmp_path / "c", results)], tmp_path / "whole")
    added, whole = ((tmp_path / name / "report.md").read_text().split("Made on")[1] for name in ("report", "whole"))
    assert added == whole


def test_runs_of_several_revisions_are_pointed_out(tmp_path):
    results = all_results()
    folder_of(tmp_path, [*results[1:], dataclasses.replace(results[0], revision="def+")])
    report([tmp_path], tmp_path / "report")
    assert "several revisions" in (tmp_path / "report" / "report.md").read_text()


def test_a_training_under_two_names_is_pointed_out(tmp_path):
    results = all_results()
    folder_of(tmp_path, [*results[1:], dataclasses.replace(results[0], same_as=results[1].run.id)])
    report([tmp_path], tmp_path / "report")
    assert "1 of them are the trainings of others" in (tmp_path / "report" / "report.md").read_text()


def test_the_page_escapes_what_it_shows_and_holds_its_pictures(tmp_path):
    results = all_results()[:1]
    results.append(dataclasses.replace(all_results()[1], status="failed", reason="<script>alert(1)</script>"))
    folder_of(tmp_path, results)
    pictures = tmp_path / "pictures" / results[0].run.id
    pictures.mkdir(parents=True)
    for name in ("photo", "test", "render"):
        Image.new("RGB", (48, 36), "red").save(pictures / f"{name}.jpg")
    report([tmp_path], tmp_path / "report")
    page = (tmp_path / "report" / "report.html").read_text()
    assert "<script>" not in page
    assert "&lt;script&gt;" in page
    assert page.count("data:image/jpeg;base64,") == 1
    assert "http" not in page


@pytest.mark.parametrize("content", ["nothing", "no results", "only a failure"])
def test_a_folder_without_results_is_refused(tmp_path, content):
    if content != "nothing":
        (tmp_path / "results").mkdir()
    if content == "only a failure":
        folder_of(tmp_path, [dataclasses.replace(all_results()[0], status="failed")])
    with pytest.raises(InputError):
        report([tmp_path], tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_the_best_of_a_row_has_the_highest_psnr_and_ssim_and_the_lowest_flip():
    results = all_results()
    order = ("paper", "default", "given")
    for k, r in enumerate(results):
        rank = order.index(r.run.method) if r.run.method in order else 1
        scores = {"psnr": 20.0 + rank, "ssim": 0.5 + 0.1 * rank, "flip": 0.1 + 0.1 * rank}
        results[k] = dataclasses.replace(r, metrics={**r.metrics, **scores})
    (study,) = studies(results)
    drawn = category_tables.results_by_category(study, with_paper=False)
    row = next(row for row in drawn.rows if row[0] == "Mud")
    bold = {heading for heading, cell in zip(drawn.headings, row, strict=True) if "**" in cell}
    assert {"oracle overlay PSNR ↑", "oracle overlay SSIM ↑", "SSA, paper's rule FLIP ↓"} <= bold
    assert not {"SSA, paper's rule PSNR ↑", "SSA, paper's rule SSIM ↑", "oracle overlay FLIP ↓"} & bold
