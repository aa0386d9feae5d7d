# make demo    install what the demo needs into .venv and run it
# make test    install what the tests need, too, and run them
# make lint    style, types, import directions
# make bench   measure; figures as JSON in build/bench/
# make clean   remove all that make made

PYTHON ?= $(shell tools/find-python.sh)
BIN := .venv/bin
# without byte code: Python writes what it needs when it is first imported, which is a small part of it
INSTALL := $(BIN)/python -m pip --disable-pip-version-check --no-input install --no-compile --constraint constraints.txt
BENCHES := render

.PHONY: demo test lint bench clean
.DELETE_ON_ERROR:

demo: .venv/.installed-core
	$(BIN)/ctmap demo --out ctmap-demo

test: .venv/.installed-dev
	@tools/system-packages.sh $(BIN)/python
	$(BIN)/python -m pytest

lint: .venv/.installed-dev
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

bench: .venv/.installed-core
	@mkdir -p build/bench
	@for name in $(BENCHES); do $(BIN)/ctmap bench $$name --json build/bench/$$name.json || exit 1; done

clean:
	rm -rf .venv ctmap-demo build dist *.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	find ctmap_gtsam factors sequences tests -name __pycache__ -type d -prune -exec rm -rf {} +

# a stamp each, so that a second run installs nothing again
.venv/.installed-core: pyproject.toml constraints.txt | $(BIN)/pip
	$(INSTALL) --editable .
	@touch $@

.venv/.installed-dev: .venv/.installed-core
	$(INSTALL) --editable '.[dev]'
	@touch $@

$(BIN)/pip:
	@test -n "$(PYTHON)" || exit 1
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo "$(PYTHON) can't make virtual environments. Debian, Ubuntu: apt-get install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv --clear .venv
