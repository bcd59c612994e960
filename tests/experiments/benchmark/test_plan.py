"""Plans: what is run, in which order, under which id, with which settings."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys

import pytest
from made_results import benchmark

from ssa_nerfstudio.errors import InputError
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import (
    Benchmark,
    Part,
    SceneEntry,
    Tradeoff,
    read_benchmark,
)
from ssa_nerfstudio.experiments.benchmark.specification.plan import Run, marks, plan, plan_tradeoff
from ssa_nerfstudio.experiments.configuration import build, shipped


def test_every_combination_is_there_once_but_those_that_mean_nothing():
    runs = plan(benchmark())
    assert len({run.id for run in runs}) == len(runs) == 2 * 2 * 2 * (3 * 6 - 1)
    assert not [run for run in runs if run.method == "given" and run.effect == "none"]


def test_parts_run_in_their_order_and_repeat_nothing():
    first = Part(methods=("default",), effects=("mud",))
    second = Part(methods=("3dgs", "default"), effects=("mud", "none"))
    runs = plan(benchmark(parts=(first, second)))
    assert [(run.scene, run.effect, run.method) for run in runs] == [
        ("attic", "mud", "default"),
        ("barn", "mud", "default"),
        ("attic", "mud", "3dgs"),
        ("attic", "none", "3dgs"),
        ("attic", "none", "default"),
        ("barn", "mud", "3dgs"),
        ("barn", "none", "3dgs"),
        ("barn", "none", "default"),
    ]


def test_the_papers_rule_is_weak_for_mud_and_for_real_artifacts_only():
    weights = {run.effect: run.model["sparsity_weight"] for run in plan(benchmark()) if run.method == "paper"}
    assert weights == {"none": 0.05, "dashboard": 0.05, "mud": 0.01}
    real = plan(benchmark(scenes=(SceneEntry("yard", artifact="finger"),)))
    assert {run.model["sparsity_weight"] for run in real if run.method == "paper"} == {0.01}


def test_a_scene_with_an_artifact_of_its_own_gets_no_other_and_has_no_known_truth():
    runs = plan(benchmark(scenes=(SceneEntry("yard", artifact="finger"),)))
    assert {(run.effect, run.real) for run in runs} == {("finger", True)}
    assert "given" not in {run.method for run in runs}


def test_clean_counterparts_are_trained_on_where_nothing_is_asked_to_be_in_front():
    yard = SceneEntry("yard", artifact="finger", clean="clean", mask="finger.png")
    runs = plan(benchmark(scenes=(yard,)))
    described = {(run.effect, run.real, run.counterparts, run.mask) for run in runs}
    assert described == {("finger", True, "", "finger.png"), ("none", False, "clean", "finger.png")}
    assert len({run.dataset for run in runs}) == 2
    only = plan(benchmark(scenes=(yard,), parts=(Part(methods=("3dgs",), effects=("mud",)),)))
    assert [run.effect for run in only] == ["finger"]


def test_effects_are_put_in_front_of_counterparts_where_a_scene_states_no_artifact():
    game = SceneEntry("yard", name="game", clean="clean")
    runs = plan(benchmark(scenes=(game,), parts=(Part(("3dgs", "given"), effects=("none", "mud")),)))
    assert {(run.method, run.effect, run.real, run.counterparts) for run in runs} == {
        ("3dgs", "none", False, "clean"),
        ("3dgs", "mud", False, "clean"),
        ("given", "mud", False, "clean"),
    }


def test_exposure_is_part_of_a_run_and_of_its_dataset():
    plain, varying = (
        plan(Benchmark((SceneEntry("barn", exposure=e),), (Part(("3dgs",), effect_seed=2),)))[0] for e in (0, 0.2)
    )
    assert plain.id != varying.id
    assert plain.dataset != varying.dataset
    assert (plain.effect_seed, varying.effect_seed) == (0, 2)  # it decides the draw of the exposures
    with pytest.raises(ValueError, match="exposure"):
        SceneEntry("barn", exposure=2.0)


def test_a_run_that_uses_no_later_field_keeps_the_id_of_earlier_results():
    runs = {run.id: run for run in plan(read_benchmark("captures"))}
    earlier = runs["plush-dashboard-default-adc-7000-s0-7017f9b4"]
    assert dataclasses.replace(earlier, mask="hood.png").id not in runs
    assert dataclasses.replace(earlier, clean_tests=False).id not in runs


def test_a_candidate_starts_from_the_row_it_names():
    part = Part(methods=("robustnerf", "robust-08", "softer"), effects=("mud",))
    candidates = {"robust-08": {"method": "robustnerf", "inlier_quantile": 0.8}, "softer": {"sparsity": "log"}}
    runs = plan(benchmark(scenes=(SceneEntry("barn"),), parts=(part,), candidates=candidates))
    adc = {"strategy": "adc"}
    assert [(run.baseline, run.model) for run in runs] == [
        ("robustnerf", adc),
        ("robustnerf", {**adc, "inlier_quantile": 0.8}),
        ("", {**adc, "overlay": "on", "sparsity": "log"}),
    ]


def test_on_and_off_are_words_where_a_setting_has_those():
    stated = {"overlay": True, "exposure": False, "sparsity": False, "overlay_light": "auto", "guards": False}
    part = Part(methods=("odd",), effects=("mud",))
    (run, *_) = plan(benchmark(parts=(part,), candidates={"odd": stated}))
    assert {name: run.model[name] for name in stated} == {
        "overlay": "on",
        "exposure": "off",
        "sparsity": "off",
        "overlay_light": "auto",
        "guards": False,
    }


def test_whatever_changes_the_outcome_changes_the_id():
    run = plan(benchmark())[0]
    others = [
        {"seed": 5},
        {"steps": 701},
        {"model": {**run.model, "sparsity": "log"}},
        {"image_scale": 0.5},
        {"effect_seed": 1},
        {"downscale": 2},
        {"nerfstudio_method": "ssa-splatfacto-paper"},
        {"baseline": "robustnerf"},
    ]
    ids = {dataclasses.replace(run, **change).id for change in others}
    assert len({*ids, run.id}) == 1 + len(others)


def test_a_run_survives_json_with_its_id():
    run = plan_tradeoff(read_benchmark("smoke"))[-1]
    read = build(Run, json.loads(json.dumps(dataclasses.asdict(run))), "here")
    assert read == run
    assert read.id == run.id


def test_ids_are_the_same_in_every_process():
    code = "from ssa_nerfstudio.experiments.benchmark.specification import plan, benchmark_file as s; "
    code += "print([r.id for r in plan.plan(s.read_benchmark('smoke'))])"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.strip() == str([run.id for run in plan(read_benchmark("smoke"))])


def test_planning_loads_neither_torch_nor_nerfstudio():
    code = "import sys; from ssa_nerfstudio.experiments.benchmark.specification import plan, benchmark_file as s; "
    code += "plan.plan(s.read_benchmark('smoke')); print(sorted({'torch', 'nerfstudio'} & sys.modules.keys()))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


@pytest.mark.parametrize("name", sorted(shipped("benchmarks")))
def test_shipped_benchmarks_can_be_planned(name):
    stated = read_benchmark(name)
    assert plan(stated) or stated.tradeoff
    if stated.tradeoff:
        assert plan_tradeoff(stated)


def test_a_tradeoff_puts_nothing_in_front_of_a_scene_that_carries_an_artifact():
    road = SceneEntry("road", artifact="bonnet")
    tradeoff = Tradeoff(("barn", "road"), knobs={"overlay_downscale": [2]}, effect="mud", marks=4)
    runs = plan_tradeoff(benchmark(scenes=(*benchmark().scenes, road), tradeoff=tradeoff))
    assert [(run.scene, run.effect) for run in runs] == [*2 * [("barn", "mud")], *2 * [("road", "bonnet")]]


def test_a_tradeoff_varies_one_knob_at_a_time_and_repeats_no_base():
    knobs = {"steps": [700, 7000], "overlay_downscale": [1, 2], "densification": ["mcmc"]}
    tradeoff = Tradeoff(
        ("barn",), knobs=knobs, base={"overlay_downscale": 1}, together=({"steps": 700, "cap_max": 9},), marks=4
    )
    runs = plan_tradeoff(benchmark(tradeoff=tradeoff))
    variations = [run.variation for run in runs]
    assert variations == [
        {},
        {"steps": 700},
        {"overlay_downscale": 2},
        {"densification": "mcmc"},
        {"steps": 700, "cap_max": 9},
    ]
    assert [run.steps for run in runs] == [7000, 700, 7000, 7000, 700]
    assert runs[2].model["overlay_downscale"] == 2
    assert runs[3].model["strategy"] == runs[3].densification == "mcmc"
    assert {run.model["overlay"] for run in runs} == {"on"}
    assert all(len(run.marks) == 4 and run.marks[-1] == run.steps for run in runs)


@pytest.mark.parametrize(("steps", "count"), [(1, 1), (1, 8), (10, 8), (7000, 8), (30000, 12)])
def test_marks_rise_to_the_last_step(steps, count):
    stops = marks(steps, count)
    assert list(stops) == sorted(set(stops))
    assert stops[0] >= 1
    assert stops[-1] == steps
    assert len(stops) <= count


@pytest.mark.parametrize(
    ("text", "culprit"),
    [
        ("scenes: []", "at least one"),
        ("scenes: [{data: a}, {data: b/a}]", "names of their own"),
        ("scenes: [{data: a}]\nparts: [{methods: [ours]}]", "no method 'ours'"),
        ("scenes: [{data: a}]\nparts: [{methods: [3dgs], scenes: [b]}]", "no scene 'b'"),
        ("scenes: [{data: a}]\nparts: [{methods: [3dgs], steps: 0}]", "steps must be at least 1"),
        (
            "scenes: [{data: a}]\nparts: [{methods: [3dgs], densification: [both]}]",
            "densification\\[0\\]: Input should be 'adc' or 'mcmc'",
        ),
        ("scenes: [{data: a, downscale: 0}]", "downscale"),
        ("scenes: [{data: 'a b'}]", "letters, digits"),
        ("scenes: [{data: a, mask: b}]", "a: mask and clean_tests are for scenes that state their artifact"),
        ("scenes: [{data: a, artifact: mud, clean_tests: false}]", "a mask of the artifact is needed"),
        ("scenes: [{data: a}]\ncandidates: {paper: {sparsity: log}}", "candidate 'paper'"),
        ("scenes: [{data: a}]\ncandidates: {mine: {method: ours}}", "no method 'ours'"),
        (
            "scenes: [{data: a}]\ntradeoff: {scenes: [a], knobs: {steps: 5}}",
            "tradeoff.knobs.steps: .* valid array, got 5",
        ),
        ("scenes: [{data: a}]\ntradeoff: {scenes: [a], knobs: {steps: []}}", "knobs.steps needs at least one"),
        ("scenes: [{data: a}]\ntradeoff: {scenes: [a], together: [{}]}", "needs at least one knob"),
        ("scenes: [{data: a, modle: {}}]", "unknown key 'modle' in scenes.0. .did you mean 'model'"),
        (
            "scenes: [{data: a}]\ncandidates: {wide: {clearance: .inf}}",
            "a setting of candidate 'wide' must be finite, got clearance: inf",
        ),
        (
            "scenes: [{data: a}]\ncandidates: {w: {sizes: [1, .nan]}}",
            "a setting of candidate 'w' must be finite, got sizes",
        ),
        (
            "scenes: [{data: a}]\nmodel: {clearance: -.inf}",
            "a setting of the model must be finite, got clearance: -inf",
        ),
        ("scenes: [{data: a, model: {clearance: .nan}}]", "a setting of the model must be finite, got clearance: nan"),
        ("scenes: [{data: a}]\ntradeoff: {scenes: [a], knobs: {clearance: [.inf]}}", "a knob must be finite"),
        ("scenes: [{data: a}]\ntradeoff: {scenes: [a], base: {clearance: .nan}}", "a knob must be finite"),
    ],
)
def test_a_faulty_file_is_refused_in_one_line(tmp_path, text, culprit):
    path = tmp_path / "faulty.yaml"
    path.write_text(text)
    with pytest.raises(InputError, match=culprit) as refusal:
        read_benchmark(str(path))
    assert "\n" not in str(refusal.value)
