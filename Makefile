# All but `make bare` runs in .venv, which is made when it is missing and brought up to date when pyproject.toml has changed.
#   make demo                  ssa run on the built-in scene behind a dashboard: a few minutes on two cores, no GPU
#   make demo DATA=PHOTOS      ssa run on your photos, video or dataset
#   make docs                  the documentation as a site, in site/
#   make test, make lint       what .ci/run runs, with make docs and make bare
#   make slow                  the other tests: whole trainings, structure from motion, real photos, more readers of odd input
#   make bare                  the product alone, without experiments, in an environment of its own (.venv-bare)
#   make mutants ROOM=overlay  which changes of a folder its tests notice, all or SAMPLE=150 of them; ROOM=all: of every folder
#   make stability             every hard case, the long ones too (docs/stability.md)

VENV := .venv
READY := $(VENV)/.ready
BIN := $(VENV)/bin
BARE := .venv-bare
# The first Python that nerfstudio 1.1.5 supports, found by running it: version managers' shims exist without working.
PYTHON ?= $(shell for p in python3.12 python3.11 python3.10 python3 python; do \
	$$p -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 13))' 2>/dev/null && echo $$p && break; done)
DATA ?=
ROOM ?= overlay
DEMO := outputs/demo
# The built-in scene is small: every pixel from the start, and fewer new Gaussians than photos of megapixels need.
DEMO_OPTIONS ?= $(if $(DATA),,--steps 800 --train.pipeline.model.num-downscales 0 --train.pipeline.model.densify-grad-thresh 0.006)

# One thread a library: two workers whose libraries start a thread a core take twice as long on two cores.
PYTEST := OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --dist worksteal

.PHONY: setup demo docs test slow mutants stability lint bare format clean

# Makes an environment where there is none: $(call environment,FOLDER)
define environment
	@test -n "$(PYTHON)" || { echo "error: no Python 3.10, 3.11 or 3.12 found; install one or call make PYTHON=/path/to/python3.11" >&2; exit 2; }
	@test -x $(1)/bin/python || $(PYTHON) -m venv $(1) || { rm -rf $(1); echo "error: $(PYTHON) cannot make environments; install its venv package (Debian: apt install python3-venv)" >&2; exit 2; }
endef

setup: $(READY)

$(READY): pyproject.toml Makefile
	$(call environment,$(VENV))
	$(BIN)/python -m pip install --quiet --upgrade pip
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --editable '.[dev]'
	$(BIN)/python -m ssa_nerfstudio.plugin.compat.open3d_libraries
	@touch $@

demo: $(READY)
	@test -n "$(DATA)" -o -d $(DEMO)/dashboard || $(BIN)/ssa simulate --effects dashboard --output $(DEMO)/dashboard
	$(BIN)/ssa run "$(or $(DATA),$(DEMO)/dashboard)" --output "$(DEMO)/run$(if $(DATA),-$(notdir $(DATA:/=)))" $(DEMO_OPTIONS)

docs: $(READY)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -W ignore -m mkdocs build --strict

test: $(READY)
	$(PYTEST)

slow: $(READY)
	$(PYTEST) -m slow

mutants: $(READY)
	$(BIN)/python benchmarks/mutants.py --room $(ROOM) $(if $(SAMPLE),--sample $(SAMPLE)) $(if $(SEED),--seed $(SEED))

stability: $(READY)
	$(PYTEST) -m "stability or not stability" tests/stability tests/plugin/training/test_nonfinite.py tests/plugin/training/test_checkpoints.py

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache
	$(BIN)/pyright --pythonpath $(BIN)/python

# Installs the wheel's requirements alone, and takes a capture from photos to exports with them.
bare:
	$(call environment,$(BARE))
	PYTHONWARNINGS=ignore $(BARE)/bin/python -m pip install --quiet --upgrade pip .
	$(BARE)/bin/python -m ssa_nerfstudio.plugin.compat.open3d_libraries
	$(BARE)/bin/python tests/bare_install/make_capture.py $(BARE)/capture
	$(BARE)/bin/python tests/bare_install/check.py $(BARE)/capture

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) $(BARE) outputs build site *.egg-info
