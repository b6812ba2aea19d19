# Two commands a newcomer needs: `make demo` and `make test`. Each sets itself up in .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin

.PHONY: demo test lint types layers unit accuracy campaign clean
.DELETE_ON_ERROR:

demo: .venv/.installed
	$(BIN)/rig scan --out runs/demo-$$(date +%Y%m%d-%H%M%S)

test: lint types layers unit

lint: .venv/.installed-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
types: .venv/.installed-tests
	$(BIN)/mypy
layers: .venv/.installed-tests
	$(BIN)/lint-imports
# Files of tests go to the workers whole: what they prepare once is prepared once.
WORKERS ?= 4
unit: .venv/.installed-tests
	$(BIN)/pytest -n $(WORKERS) --dist loadfile

# The accuracy tables of docs/results.md over the scenes of ../shared/scenes (minutes).
accuracy: .venv/.installed-tests
	$(BIN)/python -m tests.reference.accuracy

# Random faults of every driver, and blows against the laser's guard (hours).
SEQUENCES ?= 10000
campaign: .venv/.installed-tests
	for driver in cobolt obis prawndo helios lasercube spb_usb spad512s; do \
		$(BIN)/python -m tests.campaigns.$${driver}_faults --sequences $(SEQUENCES) || exit; \
	done
	$(BIN)/python -m tests.campaigns.guard_kill
	$(BIN)/python -m tests.campaigns.blanking
	$(BIN)/python -m tests.campaigns.recording_kill
	$(BIN)/python -m tests.campaigns.recording_corruptions --sequences 100000
	$(BIN)/python -m tests.campaigns.recording_depth --sequences 1000
	$(BIN)/python -m tests.campaigns.effect_ablation
	$(BIN)/python -m tests.campaigns.photon_bits
	$(BIN)/python -m tests.campaigns.kernel_usb
	$(BIN)/python -m tests.campaigns.kernel_serial
	$(BIN)/python -m tests.campaigns.hil_swaps

.venv/.created:
	@test -n "$(PYTHON)" || { echo "error: no python3 found; install Python 3.11 or newer, or call make PYTHON=/path/to/python" >&2; exit 2; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "error: $(PYTHON) is older than Python 3.11; call make PYTHON=/path/to/python3.11" >&2; exit 2; }
	$(PYTHON) -m venv .venv
	touch $@
.venv/.installed: pyproject.toml .venv/.created
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	touch $@
.venv/.installed-tests: pyproject.toml .venv/.created
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[tests]'
	touch $@ .venv/.installed

clean:
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache runs
