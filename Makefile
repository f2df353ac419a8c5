# make lens    the environment if needed, then the lens of templates/thu.toml in outputs/thu
# make test    the environment if needed, then the daily suite, in two processes; with ROOM=optics tests/optics alone
# make test-all   the daily suite, the tests marked thorough, and the shares of the samples that other commits run; with
#              DURATIONS=1 it keeps how long each file takes in tests/durations.json, by which the suite is shared out
# make test-rest  of what make test-all adds, one test of four, chosen by the commit's hash, each named
# make coverage   all these tests, and how much of the package its lines have run
# make bench   what accuracy costs in time
# make accuracy   what accuracy costs in time on the full-size scenes: records what is missing or of another version, and
#              writes docs/accuracy.md and its figures; with ONLY="thu-* mitsuba" records these (python -m
#              tests.benchmarks.accuracy --list tells their names), with ONLY= writes alone
# make published   published results beside ours on the same scenes, each judged by an independent Monte Carlo, into
#              docs/published.md; ONLY= as above, and SUN_PICTURE= the path of diffinytrace's examples/img1.jpg
# make effects what each effect costs, into docs/effects.md
# make stability   the hard cases, those of make bench too, and what they measured, into docs/stability.md
# make docs    the documentation, into docs/_build/html: its tutorials and gallery run, eight minutes
# make wheel   the documentation, and with it the wheel and the source distribution, into dist
# make lint    ruff and mypy
#
# torch for Linux may bring CUDA along (gigabytes); where an index of CPU builds is at hand, name it in PIP_EXTRA_INDEX_URL.

VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: lens test test-all test-rest coverage bench accuracy published effects tradeoff stability docs wheel lint

lens: $(READY)
	$(BIN)/python generate_lens.py templates/thu.toml
	@echo "Next: $(BIN)/bstcad app for the page in your browser, or $(BIN)/bstcad --help. To type bstcad alone, activate $(VENV):"
	@echo "  bash, zsh: source $(BIN)/activate   fish: source $(BIN)/activate.fish   PowerShell: $(BIN)/Activate.ps1"

# Compiled modules are kept even where PYTHONDONTWRITEBYTECODE is set: without them each process that a test starts takes
# 0.4 s longer, and each worker 8 s to read the tests.
TEST = PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -q -n 2 --dist loadfile --no-loadscope-reorder \
    $(if $(ROOM),$(wildcard tests/$(ROOM) tests/test_$(ROOM).py)) $(if $(DURATIONS),--record-durations)

ALL = 'not slow and not bench'

test: $(READY)
	$(TEST)

test-all: $(READY)
	$(TEST) -m $(ALL)

test-rest: $(READY)
	$(TEST) -m 'thorough and not slow and not bench' --in-turn 4 -vv

coverage: $(READY)
	$(TEST) -m $(ALL) --cov --cov-report=term:skip-covered

bench: $(READY)
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e '.[dev,judges]'
	$(BIN)/python -m pytest -q -s -m bench

accuracy: $(READY)
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e '.[dev,judges]'
	$(BIN)/python -m tests.benchmarks.accuracy $(if $(filter undefined,$(origin ONLY)),,--only $(foreach name,$(ONLY),'$(name)'))

published: $(READY)
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e '.[dev,judges]'
	$(BIN)/python -m tests.benchmarks.published $(if $(filter undefined,$(origin ONLY)),,--only $(ONLY)) \
	    $(if $(SUN_PICTURE),--sun-picture '$(SUN_PICTURE)')

effects: $(READY)
	$(BIN)/python -m tests.benchmarks.effects_table

tradeoff: $(READY)
	$(BIN)/python -m tests.benchmarks.wavefront_weights

stability: $(READY)
	$(BIN)/python -m pytest -q tests/hard_cases -m 'not slow' --stability docs/stability.md
	$(BIN)/python -m tests.hard_cases.designs docs/stability.md

docs: $(READY)
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e '.[dev,docs]'
	$(BIN)/python -m sphinx -W --keep-going -q -d docs/_build/doctrees docs docs/_build/html
	@echo "Documentation: docs/_build/html/index.html"

wheel: docs
	$(BIN)/python -m pip install --disable-pip-version-check -q -c constraints.txt -e '.[dev,docs,release]'
	rm -rf dist
	$(BIN)/python -m build --sdist --wheel --outdir dist .
	$(BIN)/python -m twine check --strict dist/*

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "bstcad needs Python 3.11 or newer; name one with: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
	    { echo "No environment could be made; on Debian or Ubuntu run: sudo apt install python3-venv"; exit 1; }
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@$(BIN)/python -c 'import cadquery' || \
	    { echo "A system library is missing (see above); on Debian or Ubuntu run: sudo apt install libgl1 libx11-6"; \
	      exit 1; }
	@echo "Compiling the kernels, once (about a minute)"
	@$(BIN)/python -m bstcad.cli generate templates/disk.toml --quality draft --set lens.back.control_points=65 \
	    -o $(VENV)/first-run > $(VENV)/first-run.log 2>&1; \
	    test $$? -le 1 || { cat $(VENV)/first-run.log; exit 1; }
	@touch $@
