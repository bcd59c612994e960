"""A folder of the package, every change of it, and which of them the folder's tests notice."""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Lock
from typing import Any

from mutmut.stats import status_by_exit_code

from .picking import quickest_first, statement
from .trials import TIMEOUT
from .undecorated import undecorated

ROOT = Path(__file__).parents[2]
SETTINGS = """
[tool.mutmut]
source_paths = ["ssa_nerfstudio"]
only_mutate = ["ssa_nerfstudio/{room}/*"]
also_copy = ["configs", "benchmarks", "docs"]
"""
GENERATE = """
from mutmut import __main__ as mutmut
mutmut.makedirs("mutants", exist_ok=True)
mutmut.copy_src_dir()
mutmut.copy_also_copy_files()
mutmut.create_mutants(1)
"""
NOTICED = ("killed", "timeout", "segfault", "suspicious")  # the last: any other exit code, such as that of an abort
KNOWN = ("killed", "segfault", "suspicious")
"""Verdicts that stand while the function does; others are tried again, because tests may have been added since."""
NO_TESTS = 33
"""mutmut's exit code of a change that no test reaches."""


@dataclass(frozen=True)
class ChangedFolder:
    """A folder of the package whose changes its own tests are to notice."""

    room: str
    """Below ssa_nerfstudio, and below tests."""
    folder: Path
    """Where a copy of the package lies, and what was found is kept."""

    def prepared(self) -> dict[str, str]:
        """Copy the package, make all changes of the folder, and return what is known of each."""
        self._copy()
        subprocess.run([sys.executable, "-c", GENERATE], cwd=self.folder, check=True, stdout=subprocess.DEVNULL)
        return self.found()

    def found(self) -> dict[str, str]:
        """The verdict on each change, in mutmut's words."""
        codes = [json.loads(path.read_text())["exit_code_by_key"] for path in self._mutants.rglob("*.meta")]
        return {name: status_by_exit_code[code] for known in codes for name, code in known.items()}

    def try_changes(self, names: list[str], children: int, budget: float, named: bool = False) -> None:
        """Run the tests that reach each, until one fails, and keep the verdicts.

        Args:
            names: of changes.
            children: tried at once.
            budget: seconds of tests for each change; those that take longer together are left out.
            named: use all tests of files that name the changed module, and do not measure which reach the change.
        """
        known = self._named(names) if named else self._reached(names)
        passing: dict[str, bool] = {}
        keeping = Lock()

        def tried(name: str) -> None:
            worker = workers.get()
            tests, seconds = quickest_first(known["reached"][name], known["seconds"], budget)
            code = NO_TESTS
            while tests := [test for test in tests if passing.get(test, True)]:
                code, last = worker.answer(_as_imported(name), tests, 60 + 4 * seconds)
                if code in (0, TIMEOUT) or not last:
                    break
                if last not in passing:
                    passing[last] = worker.answer("", [last], 600)[0] == 0
                if passing[last]:  # by itself, without the change
                    break
                code = NO_TESTS
            with keeping:
                self._keep(name, code)
            workers.put(worker)
            print(f"{self.room}: {status_by_exit_code[code]} {name}", flush=True)

        workers: SimpleQueue[_Worker] = SimpleQueue()
        for _ in range(children):
            workers.put(_Worker(self._mutants, f"tests/{self.room}"))
        with ThreadPoolExecutor(children) as pool:
            list(pool.map(tried, names))
        for _ in range(children):
            workers.get().end()

    def shown(self, name: str) -> str:
        """The difference that a change makes."""
        command = [sys.executable, "-m", "mutmut", "show", name]
        return subprocess.run(command, cwd=self.folder, capture_output=True, text=True, check=True).stdout

    @property
    def _mutants(self) -> Path:
        return self.folder / "mutants"

    def _copy(self) -> None:
        """Copy what has changed, so that what was tried stays known."""
        for kind in ("ssa_nerfstudio", "configs", "tests", "benchmarks", "docs"):
            for path in (ROOT / kind).rglob("*"):
                place = self.folder / path.relative_to(ROOT)
                if path.is_file() and "__pycache__" not in path.parts:
                    content = path.read_bytes()
                    if path.is_relative_to(ROOT / "ssa_nerfstudio" / self.room) and path.suffix == ".py":
                        content = undecorated(content.decode()).encode()
                    place.parent.mkdir(parents=True, exist_ok=True)
                    if not place.exists() or place.read_bytes() != content:
                        place.write_bytes(content)
        settings = (ROOT / "pyproject.toml").read_text() + SETTINGS.format(room=self.room)
        (self.folder / "pyproject.toml").write_text(settings)

    def _keep(self, name: str, code: int) -> None:
        meta = Path(f"{self._file(name)}.meta")
        content = json.loads(meta.read_text())
        content["exit_code_by_key"][name] = code
        meta.write_text(json.dumps(content, indent=4))

    def _file(self, name: str) -> Path:
        module = self._mutants / name.rpartition(".")[0].replace(".", "/")
        return module / "__init__.py" if module.is_dir() else module.with_suffix(".py")

    def _reached(self, names: list[str]) -> dict[str, Any]:
        """Seconds of each test, and the tests that reach each change; measured once for the same tests and changes."""
        changes = {name: self._place(name) for name in names}
        tests = [path.read_bytes() for path in sorted((self._mutants / "tests" / self.room).rglob("*.py"))]
        digest = hashlib.sha256(b"".join(tests)).hexdigest()
        path = self.folder / "reached.json"
        if path.exists():
            known = json.loads(path.read_text())
            if known["tests"] == digest and all(known["changes"].get(name) == changes[name] for name in names):
                return known
        wanted, result = self.folder / "changes.json", self.folder / "measured.json"
        wanted.write_text(json.dumps(changes))
        # A test of speed takes longer beside others, whatever is changed.
        _run_in(self._mutants, "reach", str(wanted), str(result), f"tests/{self.room}", "-k", "not speed").wait()
        known = {**json.loads(result.read_text()), "tests": digest, "changes": changes}
        path.write_text(json.dumps(known))
        if known["failed"]:
            print(f"{self.room}: failed without a change, and are not used: {', '.join(known['failed'])}", flush=True)
        return known

    def _named(self, names: list[str]) -> dict[str, Any]:
        """As `_reached`, without running tests: for each change those of files that name its module, or package."""
        asked = [sys.executable, "-m", "pytest", "--collect-only", "-p", "no:cacheprovider", f"tests/{self.room}"]
        listed = subprocess.run([*asked, "-k", "not speed"], cwd=self._mutants, capture_output=True, text=True).stdout
        tests = [line for line in listed.splitlines() if "::" in line]
        texts = {name: (self._mutants / name).read_text() for name in {test.partition("::")[0] for test in tests}}
        reached = {}
        for name in names:
            package, _, module = _as_imported(name).rpartition(".")[0].rpartition(".")
            for imports in (rf"{re.escape(package)}(\.| import .*\b){re.escape(module)}\b", rf"{re.escape(package)}\b"):
                files = {file for file, text in texts.items() if re.search(imports, text)}
                if files:
                    break
            reached[name] = [test for test in tests if test.partition("::")[0] in files]
        return {"reached": reached, "seconds": dict.fromkeys(tests, 1.0)}

    def _place(self, name: str) -> dict[str, Any]:
        """The changed lines in the original function, in the file that has all of the file's changes."""
        file = self._file(name)
        spans = json.loads(Path(f"{file}.spans").read_text())["spans"]
        function = name.rpartition(".")[2]
        original = f"{function.rpartition('__mutmut_')[0]}__mutmut_orig"
        lines = file.read_text().splitlines()
        before, after = (lines[first - 1 : last] for first, last in (spans[original], spans[function]))
        after = [line.replace(f"def {function}(", f"def {original}(") for line in after]
        changed = (place for place, (old, new) in enumerate(zip(before, after, strict=False)) if old != new)
        places = statement(before, next(changed, 0))
        return {
            "file": str(file),
            "lines": [spans[original][0] + place for place in places],
            "function": _as_imported(name).rpartition("__mutmut_")[0],
            "change": "\n".join(after),
        }


class _Worker:
    """A process that has imported a folder's tests."""

    def __init__(self, folder: Path, tests: str) -> None:
        self._process = _run_in(folder, "trials", tests)

    def answer(self, mutant: str, tests: list[str], seconds: float) -> tuple[int, str]:
        """The exit code of tests under a mutant, and the test that ran last."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps({"mutant": mutant, "tests": tests, "seconds": seconds}), file=self._process.stdin, flush=True)
        code, last = json.loads(self._process.stdout.readline())
        return code, last

    def end(self) -> None:
        """End the process."""
        self._process.communicate()


def _run_in(folder: Path, module: str, *arguments: str) -> subprocess.Popen[str]:
    # What is tested comes before what is installed, also in processes that tests start.
    environment = {**os.environ, "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    command = [sys.executable, "-m", f"benchmarks.mutation.{module}", *arguments]
    return subprocess.Popen(
        command, cwd=folder, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


def _as_imported(name: str) -> str:
    return name.replace(".__init__.", ".")
