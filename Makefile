# Two commands a newcomer needs: `make demo` and `make test`. Each sets itself up in .venv. `make help` lists the others.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
# As `rig` does itself: threads of numpy's linear algebra only get into each other's way.
export OPENBLAS_NUM_THREADS ?= 1
# Images of containers often set it. Then each of the hundreds of processes that tests start compiles all modules anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo help install test long checks kernels lint types layers house docs figures collected unit audit clean
.PHONY: packages pythons accuracy accuracy-rows accuracy-joint accuracy-calibration
.PHONY: campaign campaign-devices campaign-guard campaign-recording campaign-simulation campaign-calibration
.PHONY: campaign-inputs
.DELETE_ON_ERROR:

demo: .venv/.installed  ## scan the simulated rig in a foggy street
	$(BIN)/rig scan --out runs/demo-$$(date +%Y%m%d-%H%M%S)
	@echo "next: $(BIN)/python -m pip install -e '.[view]', then $(BIN)/rig demo, shows such a scan in the browser"

install: .venv/.installed-tests  ## set up .venv with everything that tests need; again after a change of pyproject.toml

help:  ## this list
	@awk -F' *## ' '/^[a-z-]+:.*## / { sub(/:.*/, "", $$1); printf "%-21s %s\n", $$1, $$2 }' Makefile

# The kernels are compiled once, by one core, while the other makes all else: four workers that start cold would each
# compile them. The kernels come first, since they take longest.
test: .venv/.installed-tests  ## lint, types, import layers, the tree's figures, the site and all tests but long ones
	$(MAKE) --jobs=2 --output-sync=target kernels checks docs collected NOTEBOOKS=off SITE=docs/_build/check
	$(PYTEST) -m "not long" --durations=25

long: kernels  ## tests that `make test` leaves out: more of what shorter tests show (ten minutes)
	$(PYTEST) -m long --durations=25

checks: lint types layers house
kernels: .venv/.installed-tests
	$(BIN)/rig warmup

lint: .venv/.installed-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
types: .venv/.installed-tests
	$(BIN)/mypy
layers: .venv/.installed-tests
	$(BIN)/lint-imports
house: .venv/.installed-tests
	$(BIN)/python -m tests.reference.house --limits
# Notebooks are run while the site is built; `make test` leaves that to the tests.
NOTEBOOKS ?= force
SITE ?= docs/_build/html
docs: .venv/.installed-tests  ## the documentation site in docs/_build/html; its warnings are errors; needs no network
	NOTEBOOKS=$(NOTEBOOKS) $(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -c docs . $(SITE)
figures: .venv/.installed-tests  ## draw the figures of docs/figures/ anew
	$(BIN)/python -m docs.generate.figures
# Python files of tests are compiled, with messages for their assertions: else each worker does so itself, 10 s long.
collected: .venv/.installed-tests
	-$(BIN)/pytest --collect-only -qq > /dev/null
# Files of tests go to the workers whole: what they prepare once is prepared once.
WORKERS ?= 4
PYTEST = $(BIN)/pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder
unit: .venv/.installed-tests  ## the quick tests of single modules, for while you develop (90 s)
	$(PYTEST) -m "not slow" tests/unit

# With the network alone: it asks osv.dev about the packages in .venv. A package that it does not know fails it.
AUDIT := .venv/audit
audit: .venv/.installed-tests  ## known weaknesses of the packages in .venv, by pip-audit; needs the network
	test -x $(AUDIT)/bin/pip-audit || { $(PYTHON) -m venv $(AUDIT) && $(AUDIT)/bin/python -m pip install --quiet pip-audit; }
	$(BIN)/python -m pip freeze --exclude-editable > $(AUDIT)/packages.txt
	$(AUDIT)/bin/pip-audit --strict --no-deps --disable-pip --vulnerability-service osv --requirement $(AUDIT)/packages.txt

packages: .venv/.installed-tests  ## wheel and source distribution, installed and tried outside the checkout (ten minutes)
	$(BIN)/python -m tests.campaigns.packages
pythons: .venv/.installed-tests  ## the same on every Python found, and with the oldest dependencies allowed (an hour)
	$(BIN)/python -m tests.campaigns.packages --every --oldest

# Over the scenes of ../shared/scenes or, where there are none, the built-in one.
accuracy: accuracy-rows accuracy-joint accuracy-calibration  ## the three below: tables of docs/results/ (hours)

accuracy-rows: .venv/.installed-tests  ## argmax, edge and likelihood beside the genie
	$(BIN)/python -m tests.reference.tables.accuracy
accuracy-joint: .venv/.installed-tests  ## joint beside what is asked, its prior; fog meter's error bars
	$(BIN)/python -m tests.reference.tables.joint_accuracy --estimators joint
	$(BIN)/python -m tests.reference.tables.moving --rows 128
	$(BIN)/python -m tests.reference.tables.fog_coverage
PICTURES := ../shared/calibration-images
accuracy-calibration: .venv/.installed-tests  ## corners of drawn boards; cameras from real chessboards, where there are any
	$(BIN)/python -m tests.reference.boards.corner_accuracy
	@test -d $(PICTURES) || echo "no chessboards in $(PICTURES): left out"
	@test ! -d $(PICTURES) || $(BIN)/python -m tests.reference.boards.chessboards --folder $(PICTURES)

# Without tests.campaigns.devices.guard_false_trips, which burns all processors: nothing else could be measured beside it.
campaign: campaign-devices campaign-guard campaign-recording campaign-simulation campaign-calibration campaign-inputs
campaign:  ## the six below: what is tried at random (many hours)

SEQUENCES ?= 10000
campaign-devices: .venv/.installed-tests  ## SEQUENCES of faults on the wire of every driver; sweeps without markers; hardware in the loop
	for driver in cobolt obis ibeam prawndo pulsestreamer teensy helios lasercube etherdream nidaq spb-usb spad512s blanking; do \
		$(BIN)/python -m tests.campaigns.devices.faults $${driver} --sequences $(SEQUENCES) || exit; \
	done
	$(BIN)/python -m tests.campaigns.devices.hil_swaps
campaign-guard: .venv/.installed-tests  ## blows to scans: how long the laser shines after them
	$(BIN)/python -m tests.campaigns.devices.guard_kill
campaign-recording: .venv/.installed-tests  ## recordings killed and damaged, and depth from them
	$(BIN)/python -m tests.campaigns.recording.kill
	$(BIN)/python -m tests.campaigns.recording.corruptions --sequences 100000
	$(BIN)/python -m tests.campaigns.recording.depth --sequences 1000
campaign-simulation: .venv/.installed-tests  ## effects left out against the full model; statistics of photon bits
	$(BIN)/python -m tests.campaigns.effect_ablation
	$(BIN)/python -m tests.campaigns.photon_bits
# A rig takes some 20 s of CPU, a trial, which makes all mistakes, 180 s.
RIGS ?= 500
TRIALS ?= 30
campaign-calibration: .venv/.installed-tests  ## RIGS calibrated, TRIALS of deliberate mistakes; a second simulator; the guide
	short=0; \
	$(BIN)/python -m tests.campaigns.calibration.rigs --rigs $(RIGS) || short=1; \
	$(BIN)/python -m tests.campaigns.calibration.mistakes --trials $(TRIALS) || short=1; \
	$(BIN)/python -m tests.campaigns.calibration.fits || short=1; \
	$(BIN)/python -m tests.campaigns.calibration.guided || short=1; \
	exit $$short
INPUTS ?= 1000000
campaign-inputs: .venv/.installed-tests  ## INPUTS, or as many as 60 s of processor time allow, for every parser
	$(BIN)/python -m tests.campaigns.inputs all --inputs $(INPUTS) --seconds 60

.venv/.created:
	@test -n "$(PYTHON)" || { echo "error: no python3 found; install Python 3.11 or newer, or call make PYTHON=/path/to/python" >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "error: $(PYTHON) is older than Python 3.11; call make PYTHON=/path/to/python3.11" >&2; exit 2; }
	$(PYTHON) -m venv .venv
	touch $@
.venv/.installed: pyproject.toml .venv/.created
	@echo "installing into .venv, about a minute"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@
.venv/.installed-tests: pyproject.toml .venv/.created
	@echo "installing into .venv, about a minute"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[tests,docs]'
	touch $@ .venv/.installed

clean:  ## remove .venv, caches and runs
	rm -rf docs/_build .venv .mypy_cache .ruff_cache .pytest_cache runs
