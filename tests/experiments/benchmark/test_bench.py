"""`ssa bench` around its runs: selection, expectations, time limits, locks, clusters, refusals."""

from __future__ import annotations

import dataclasses
import fcntl
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import psutil
import pytest
import yaml
from conftest import at_work
from made_results import benchmark, folder_of, result

from ssa_nerfstudio._system.cores import usable_cores
from ssa_nerfstudio.cli import main
from ssa_nerfstudio.experiments.benchmark.execution import worker_task
from ssa_nerfstudio.experiments.benchmark.execution.dask_runner import DaskRunner
from ssa_nerfstudio.experiments.benchmark.execution.execute import RuntimeEstimate, select
from ssa_nerfstudio.experiments.benchmark.execution.results_folder import ResultsFolder
from ssa_nerfstudio.experiments.benchmark.execution.run_process import Request
from ssa_nerfstudio.experiments.benchmark.results import read_all
from ssa_nerfstudio.experiments.benchmark.specification.benchmark_file import read_benchmark
from ssa_nerfstudio.experiments.benchmark.specification.plan import plan

SSA = (sys.executable, "-m", "ssa_nerfstudio")

SHORT = """
scenes:
  - data: demo
    model: {num_downscales: 0}
parts:
  - {methods: [3dgs], effects: [none], steps: 5}
"""


def ssa(*arguments: str | Path) -> subprocess.CompletedProcess:
    return subprocess.run([*SSA, *arguments], capture_output=True, text=True, timeout=300)


def test_scenes_and_patterns_select_runs():
    runs = plan(benchmark())
    chosen = select(runs, ("barn",), ("*-mud-given-*", "*-none-3dgs-adc-*"))
    assert {(run.scene, run.effect, run.method) for run in chosen} == {
        ("barn", "mud", "given"),
        ("barn", "none", "3dgs"),
    }
    assert select(runs, (), ()) == runs


def test_a_run_takes_as_long_as_those_like_it():
    runs = plan(benchmark())
    known = [result(run) for run in runs if run.scene == "attic" and run.densification == "adc"]
    expected = RuntimeEstimate(known)
    assert RuntimeEstimate([]).seconds(runs[0]) is None
    assert expected.seconds(runs[0]) == pytest.approx(8 + 700 / 100)
    longer = dataclasses.replace(runs[0], steps=7000)
    assert expected.seconds(longer) == pytest.approx(8 + 7000 / 100)
    elsewhere = next(run for run in runs if run.scene == "barn" and run.densification == "mcmc")
    assert expected.seconds(elsewhere) == pytest.approx(15)
    slow = result(elsewhere, seconds={"startup": 5, "statistics": 1, "training": 70, "evaluation": 2})
    assert RuntimeEstimate([*known, slow]).seconds(elsewhere) == pytest.approx(78)


def test_no_run_is_started_that_would_not_end_in_time(tmp_path, capsys):
    runs = plan(read_benchmark("smoke"))
    slow = {"startup": 5.0, "statistics": 0.0, "training": 5000.0, "evaluation": 1.0}
    folder_of(tmp_path, [result(runs[0], seconds=slow)])
    (tmp_path / "scenes").mkdir()
    for run in runs:
        (tmp_path / "scenes" / run.dataset).mkdir(exist_ok=True)
    main(["bench", "smoke", "--output", str(tmp_path), "--time-limit", "10"])
    assert "Left: 4 of 5 runs; call the same again to go on" in capsys.readouterr().out
    assert not (tmp_path / "logs").exists()


def test_what_runs_at_the_time_limit_is_stopped_and_leaves_nothing(tmp_path):
    started = time.monotonic()
    done = ssa("bench", "smoke", "--output", tmp_path, "--only", "*-none-3dgs-*", "--time-limit", "0.05")
    assert done.returncode == 0, done.stderr
    assert "Left: 1 of 1 run;" in done.stdout
    assert time.monotonic() - started < 120
    assert read_all([tmp_path]) == ([], [])
    assert at_work(tmp_path) == []
    assert ssa("bench", "smoke", "--output", tmp_path, "--list").stdout.count("to do") == 5


@pytest.mark.slow
def test_a_run_that_failed_is_done_again(tmp_path):
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    (run,) = plan(read_benchmark(str(path)))
    folder = folder_of(tmp_path / "out", [result(run, status="failed", reason="the machine caught fire")])
    main(["bench", str(path), "--output", str(folder)])
    assert [each.status for each in read_all([folder])[0]] == ["finished"]


def test_a_model_that_cannot_be_kept_fails_its_run_and_a_kept_one_is_found_by_nerfstudio(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("short.yaml").write_text(SHORT)
    Path("out").mkdir()
    Path("out/models").touch()
    with pytest.raises(SystemExit):
        main(["bench", "short.yaml", "--output", "out", "--keep-models"])
    (failed,) = read_all([Path("out")])[0]
    assert (failed.status, failed.reason.split(":")[0]) == ("failed", "NotADirectoryError")
    Path("out/models").unlink()
    main(["bench", "short.yaml", "--output", "out", "--keep-models"])
    (kept,) = read_all([Path("out")])[0]
    assert kept.status == "finished"
    monkeypatch.chdir("/")
    (path,) = (tmp_path / "out" / "models" / kept.run.id).rglob("config.yml")
    config = yaml.load(path.read_text(), Loader=yaml.Loader)
    assert list(config.get_checkpoint_dir().glob("*.ckpt"))


def test_results_of_other_folders_are_taken_over(tmp_path, capsys):
    runs = plan(read_benchmark("smoke"))
    folder_of(tmp_path / "there", [result(run) for run in runs])
    taken_over = ["bench", "smoke", "--output", str(tmp_path / "here"), "--merge", str(tmp_path / "there")]
    main([*taken_over, "--list"])
    assert capsys.readouterr().out.count("finished") == 5
    assert not (tmp_path / "here").exists()
    main(taken_over)
    assert "All smoke runs" in capsys.readouterr().out
    assert len(read_all([tmp_path / "here"])[0]) == 5


@pytest.mark.slow
def test_one_training_answers_for_every_name_it_goes_by(tmp_path, capsys):
    path = tmp_path / "twice.yaml"
    path.write_text(
        "scenes: [{data: demo, model: {num_downscales: 0}}]\n"
        "parts: [{methods: [paper, l1-0.05, l1-0.01], effects: [dashboard], steps: 5}]"
    )
    runs = {run.method: run for run in plan(read_benchmark(str(path)))}
    assert runs["paper"].training == runs["l1-0.05"].training
    assert runs["paper"].training != runs["l1-0.01"].training
    known = folder_of(tmp_path / "out", [result(runs["l1-0.01"])])
    (known / "pictures" / runs["l1-0.01"].id).mkdir(parents=True)
    main(["bench", str(path), "--output", str(known), "--only", "*-paper-adc-*", "*-l1-0.05-*"])
    found = {each.run.method: each for each in read_all([known])[0]}
    assert set(found) == {"paper", "l1-0.05", "l1-0.01"}
    assert (found["paper"].same_as, found["l1-0.05"].same_as) == ("", runs["paper"].id)
    assert found["paper"].views == found["l1-0.05"].views != {}
    pictures = [sorted(p.name for p in (known / "pictures" / runs[m].id).iterdir()) for m in ("paper", "l1-0.05")]
    assert pictures[0] == pictures[1] != []
    # Known from an earlier call: nothing is trained at all.
    (known / "results" / f"{runs['paper'].id}.json").unlink()
    shutil.rmtree(known / "scenes")
    main(["bench", str(path), "--output", str(known), "--only", "*-paper-adc-*"])
    assert {each.run.method for each in read_all([known])[0]} == set(found)
    assert not (known / "scenes").exists()


def test_what_a_training_leaves_undone_is_left_under_each_of_its_names(tmp_path, capsys):
    path = tmp_path / "twice.yaml"
    path.write_text("scenes: [{data: demo}]\nparts: [{methods: [paper, l1-0.05], effects: [dashboard], steps: 5}]")
    main(["bench", str(path), "--output", str(tmp_path / "out"), "--time-limit", "0.001"])
    assert "Left: 2 of 2 runs;" in capsys.readouterr().out


def test_datasets_can_be_prepared_ahead_and_drawn_effects_suffice(tmp_path, monkeypatch, capsys):
    path = tmp_path / "rain.yaml"
    path.write_text("scenes: [{data: demo}]\nparts: [{methods: [3dgs], effects: [rain]}]")
    main(["bench", str(path), "--output", str(tmp_path / "there"), "--prepare-only"])
    assert "1 dataset ready" in capsys.readouterr().out
    (tmp_path / "here").mkdir()
    (tmp_path / "there" / "artifacts").rename(tmp_path / "here" / "artifacts")
    monkeypatch.setitem(sys.modules, "albumentations", None)  # as on a machine without it
    main(["bench", str(path), "--output", str(tmp_path / "here"), "--prepare-only"])
    for name in ("images/train_0003.png", "layers/undistorted_B.png", "transforms.json"):
        there, here = (tmp_path / side / "scenes" / "demo-rain" / name for side in ("there", "here"))
        assert there.read_bytes() == here.read_bytes()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_benchmark_that_is_stopped_says_what_it_did_and_how_it_goes_on(number, tmp_path):
    words = [*SSA, "bench", "smoke", "--output", "out"]
    running = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert running.stdout is not None
    assert running.stdout.readline() == "Making the dataset demo-dashboard ...\n"
    running.send_signal(number)
    _, err = running.communicate(timeout=60)
    assert running.returncode == 128 + number
    assert err == "stopped; the same command continues in out\n"


@pytest.mark.slow
def test_a_dask_cluster_runs_what_it_is_given(tmp_path):
    distributed = pytest.importorskip("distributed")
    path = tmp_path / "short.yaml"
    path.write_text(SHORT)
    local = {"n_workers": 1, "threads_per_worker": 1, "processes": False, "protocol": "tcp", "dashboard_address": None}
    with distributed.LocalCluster(**local) as cluster:
        done = ssa("bench", path, "--output", tmp_path / "out", "--scheduler", cluster.scheduler_address)
    assert done.returncode == 0, done.stderr
    (found,), problems = read_all([tmp_path / "out"])
    assert (found.status, problems) == ("finished", []), found.reason
    assert len(found.views) == 4
    assert not list((tmp_path / "out" / "running").iterdir())


def children() -> set[psutil.Process]:
    """Processes below this one, without that of `multiprocessing` which stays for good."""
    found = psutil.Process().children(recursive=True)
    return {child for child in found if not any("resource_tracker" in word for word in child.cmdline())}


@pytest.mark.slow
def test_on_a_gpu_a_process_is_ready_for_the_next_run_and_none_after_the_last(tmp_path):
    """Runs that fail, for there is no dataset. A process that was killed while it waited is replaced."""
    folder = ResultsFolder(tmp_path)
    before = children()
    devices: dict[str, str | None] = {}
    results = []

    def watch(requests, waiting):
        for request in requests:
            assert request.flip_processes == min(16, max(1, usable_cores() // 2))
            devices[request.run.id] = request.device

    def ended(run, result):
        results.append((run.id, result.run.id, result.status))

    runs = plan(benchmark())[:3]
    runner = DaskRunner(folder, ["4", "7"], 1, lambda run: "the command")
    assert runner.work(runs, lambda run: None, None, watch, ended) == []
    assert sorted(results) == sorted((run.id, run.id, "failed") for run in runs)
    assert all(run.dataset in folder.log(run.id).read_text() for run in runs)
    assert set(devices.values()) == {"4", "7"}
    assert children() == before
    assert list(folder.unfinished.iterdir()) == []


@pytest.mark.slow
def test_runs_begin_in_the_order_of_their_importance(tmp_path):
    """They fail at once, for there is no dataset."""
    begun: list[str] = []

    def watch(requests, waiting):
        begun.extend(request.run.id for request in requests if request.run.id not in begun)

    runs = plan(benchmark())[:6]
    runner = DaskRunner(ResultsFolder(tmp_path), [], 2, lambda run: "the command")
    assert runner.work(runs, lambda run: None, None, watch, lambda *_: None) == []
    places = [runs.index(next(run for run in runs if run.id == id)) for id in begun]
    assert len(places) == 6
    assert all(abs(place - at) <= 1 for at, place in enumerate(places))


@pytest.mark.slow
def test_a_process_that_was_killed_while_it_waited_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3")
    runs = plan(benchmark())[:2]
    requests = [Request(run, str(tmp_path), 1, "the command") for run in runs]
    first = worker_task.perform(requests[0], prepare_next=True)
    waiting = worker_task._prepared
    assert waiting is not None
    waiting._popen.kill()
    waiting._popen.wait()
    second = worker_task.perform(requests[1], prepare_next=False)
    assert [result and result.status for result in (first, second)] == ["failed", "failed"]
    assert worker_task._prepared is None
    assert list(ResultsFolder(tmp_path).unfinished.iterdir()) == []


def test_a_run_whose_request_is_removed_is_stopped(tmp_path):
    folder = ResultsFolder(tmp_path)
    (run,) = plan(benchmark())[:1]

    def remove():
        while not folder.request(run.id).exists():
            time.sleep(0.05)
        folder.request(run.id).unlink()

    thread = threading.Thread(target=remove)
    thread.start()
    assert worker_task.perform(Request(run, str(tmp_path), 1, "the command"), prepare_next=False) is None
    thread.join()
    assert at_work(tmp_path) == []


@pytest.mark.slow
def test_processes_end_with_an_interrupted_benchmark(tmp_path):
    def ended(run, result):
        raise KeyboardInterrupt

    before = children()
    runner = DaskRunner(ResultsFolder(tmp_path), ["0"], 1, lambda run: "the command")
    with pytest.raises(KeyboardInterrupt):
        runner.work(plan(benchmark())[:3], lambda run: None, None, lambda *_: None, ended)
    assert children() == before
    assert list(ResultsFolder(tmp_path).unfinished.iterdir()) == []


@pytest.mark.slow
def test_imports_are_done_while_the_run_before_is_at_work(tmp_path, monkeypatch):
    """CUDA_VISIBLE_DEVICES is how `ssa bench` learns of a GPU; that there is none is nothing to it."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    path = tmp_path / "two.yaml"
    path.write_text(SHORT.replace("3dgs", "3dgs, overlay-on"))
    assert ssa("bench", path, "--output", tmp_path / "out").returncode == 0
    first, second = (each.seconds["startup"] for each in sorted(read_all([tmp_path / "out"])[0], key=lambda r: r.ended))
    assert second < 0.7 * first


def test_a_misspelt_setting_is_refused_before_anything_runs(tmp_path, capsys):
    path = tmp_path / "misspelt.yaml"
    path.write_text(
        "scenes: [{data: demo}]\ncandidates: {misspelt: {sparsty: log}}\n"
        "parts: [{methods: [3dgs, misspelt], effects: [none], steps: 5}]"
    )
    with pytest.raises(SystemExit) as refusal:
        main(["bench", str(path), "--output", str(tmp_path / "out")])
    assert refusal.value.code == 2
    line = capsys.readouterr().err
    assert "-misspelt-" in line
    assert "the model has no setting 'sparsty'; 'sparsity' may be meant" in line
    assert not (tmp_path / "out" / "scenes").exists()


@pytest.mark.parametrize(
    ("settings", "refused"),
    [
        ("sparsity: lg", "setting 'sparsity': Input should be 'l1', 'log' or 'off', got 'lg'"),
        ("sh_degree: three", "setting 'sh_degree': Input should be a valid integer, got 'three'"),
        ("method: spotless-mlp, grouping: mpl", "setting 'grouping': Input should be 'mlp' or 'agg', got 'mpl'"),
        ("method: robustnerf, inlier_quantile: 70", "setting 'inlier_quantile': Input should be less than or equal"),
        ("method: desplat, distractors: 0", "setting 'distractors': Input should be greater than or equal to 1, got 0"),
        ("method: difix3d, weights: 5", "no weights are stated (nvidia/difix_ref"),
        ("method: spotless-mlp, features: [a]", "no weights are stated (stabilityai/stable-diffusion-2-1"),
        ("setup: 3", "the model has no setting 'setup'"),
        ("__class__: 3", "the model has no setting '__class__'"),
        ("_target: 3", "the model has no setting '_target'"),
        ("own_steps: [refine_every]", "the model has no setting 'own_steps'"),
    ],
)
def test_a_value_that_a_setting_cannot_have_is_refused_before_anything_runs(tmp_path, capsys, settings, refused):
    (tmp_path / "odd.yaml").write_text(
        f"scenes: [{{data: demo}}]\ncandidates: {{odd: {{{settings}}}}}\n"
        "parts: [{methods: [3dgs, odd], effects: [none], steps: 5}]"
    )
    with pytest.raises(SystemExit) as refusal:
        main(["bench", str(tmp_path / "odd.yaml"), "--output", str(tmp_path / "out")])
    assert refusal.value.code == 2
    line = capsys.readouterr().err
    assert "-odd-" in line
    assert refused in line
    assert not (tmp_path / "out" / "scenes").exists()


def test_a_run_that_fails_says_why_and_fails_the_command(tmp_path, capsys):
    path = tmp_path / "negative.yaml"
    path.write_text(
        "scenes: [{data: demo}]\ncandidates: {negative: {sparsity_weight: -1.0}}\n"
        "parts: [{methods: [negative], effects: [none], steps: 5}]"
    )
    (run,) = plan(read_benchmark(str(path)))
    with pytest.raises(SystemExit) as failure:
        main(["bench", str(path), "--output", str(tmp_path / "out")])
    assert failure.value.code == 3
    said = capsys.readouterr()
    assert f"1 run failed, first {run.id}: InputError: --pipeline.model.sparsity-weight must be at least 0" in said.err
    assert "call the same again to repeat them" in said.err
    assert "are done" not in said.out
    (failed,), _ = read_all([tmp_path / "out"])
    assert failed.status == "failed"
    assert failed.command == f"ssa bench {path} --output {tmp_path / 'out'} --only {run.id}"
    assert "must be at least 0" in failed.reason
    assert RuntimeEstimate([failed]).seconds(run) is None


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        (["nothing"], "benchmarks has no 'nothing'"),
        (["smoke", "--scenes", "garden"], "no scene 'garden'"),
        (["smoke", "--only", "*-snow-*"], "no run's id matches *-snow-*"),
        (["smoke", "--time-limit", "0"], "--time-limit"),
        (["smoke", "--time-limit", "nan"], "--time-limit"),
        (["smoke", "--time-limit", "inf"], "--time-limit"),
        (["smoke", "--runs-per-device", "0"], "--runs-per-device"),
        (["smoke", "--merge", "nowhere"], "holds no results"),
        (["captures", "--prepare-only"], "set SSA_DATA"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(tmp_path, monkeypatch, capsys, arguments, culprit):
    monkeypatch.setenv("SSA_DATA", str(tmp_path / "empty"))
    with pytest.raises(SystemExit) as refusal:
        main(["bench", *arguments, "--output", str(tmp_path / "out")])
    assert refusal.value.code == 2
    line = capsys.readouterr().err
    assert culprit in line
    assert line.count("\n") == 1
    assert not (tmp_path / "out" / "scenes").exists()


def test_a_second_benchmark_in_one_folder_is_refused(tmp_path, capsys):
    with (tmp_path / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(SystemExit):
            main(["bench", "smoke", "--output", str(tmp_path)])
    assert "another ssa bench" in capsys.readouterr().err


def test_an_output_that_is_a_file_is_refused(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit):
        main(["bench", "smoke", "--output", str(tmp_path / "file")])
    assert "is a file" in capsys.readouterr().err
