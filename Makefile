# Two commands do everything on a fresh machine: `make bench` and `make test`.
PYTHON ?= python3
DATA   ?= $(or $(BALLFG_DATA),../shared/data)
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
WARM   := $(VENV)/.compiled
CODE   := $(wildcard ballfg/dynamics/*.yaml factors/*.py $(addprefix ballfg/dynamics/, compiled/*.py compiled/*/*.py effects/*.py motion/*.py))
SOURCES := ballfg factors learning benchmarks tests docs/results
TOOLS  := build/tools/bin/pip-audit
OLDEST := tests/factors tests/files tests/importing/test_forms.py tests/live/test_bag.py tests/dynamics/test_model_file.py \
	tests/dynamics/compiled/test_kept.py \
	tests/dynamics/networks/test_learned_file.py tests/estimation/smoother tests/prediction tests/pages tests/tracks \
	tests/vision/test_camera_file.py tests/cli/test_estimate.py tests/cli/test_show.py tests/simulation tests/front

export OMP_NUM_THREADS ?= 1
unexport PYTHONDONTWRITEBYTECODE  # interpreters that tests start compile the package once

.PHONY: bench test test-all check check-speed check-deps check-oldest docs results-page package sbom readme fuzz mutants format clean

bench: $(WARM)  ## the estimator comparison: table, results/results.json, pictures; measured tracks too where they are
	$(BIN)/ballfg-bench estimators --out results
	@for set in aimy ballgun; do if [ -d "$(DATA)/$$set" ]; then \
		$(BIN)/ballfg-bench estimators --data "$(DATA)/$$set" --out results/$$set || exit 1; \
	else echo "no measured tracks at $(DATA)/$$set: skipped"; fi; done

test: $(WARM)  ## the tests but for those marked `thorough`: a quarter of an hour on two cores
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not thorough"

test-all: $(WARM)  ## all tests: also README, tutorials, cold compilation, fuzz, bombs, signals, full disks, videos, campaigns
	$(BIN)/python -m pytest -n 2 --dist worksteal

check: $(READY)  ## format, lint, types (of the installed package: its folders lie apart in the source tree)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	rm -rf build/typed build/lib && $(BIN)/pip install --quiet --no-deps --no-build-isolation --target build/typed .
	$(BIN)/mypy --config-file pyproject.toml --cache-dir .mypy_cache build/typed/ballfg
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

docs: check  ## the documentation as a site: build/site/index.html
	@echo "build/site/index.html"

check-speed: $(WARM)  ## times as multiples of a control, against those of the baseline; two minutes, nothing else running
	$(BIN)/ballfg-bench speed --gate benchmarks/speed/baseline.json --out results/speed

results-page: $(READY)  ## docs/benchmarks.md from the result files in docs/results
	$(BIN)/python docs/results/page.py

readme:  ## types all blocks of the README in a fresh clone, installation included; needs no environment
	$(PYTHON) tests/type_readme.py

package: $(READY)  ## wheel and sdist in dist/, tried in a bare environment away from the sources
	rm -rf dist build/bare build/lib && $(BIN)/python -m build --no-isolation --outdir dist .
	$(PYTHON) -m venv build/bare
	build/bare/bin/python -m pip install --quiet -c constraints.txt dist/*.whl
	cd build/bare && rm -rf tried && mkdir tried && cd tried && ../bin/ballfg example --tracks 6 \
	&& ../bin/ballfg estimate example/shots --out states.csv && ../bin/ballfg info
	$(MAKE) sbom

sbom: $(TOOLS)  ## what the wheel brings along, as CycloneDX JSON beside it; after `make package`
	build/tools/bin/cyclonedx-py environment --pyproject pyproject.toml --mc-type library --output-reproducible \
		--of JSON -o dist/ballfg.cdx.json build/bare/bin/python

check-deps: $(READY) $(TOOLS)  ## known vulnerabilities (needs a network, and says so without one) and licences; STRICT=1
	$(BIN)/python -m tests.dependencies.audit $(TOOLS) $(if $(STRICT),--strict)
	$(BIN)/python -m tests.dependencies.licences

fuzz: $(READY)  ## ten minutes of damaged files for every reader; what is found goes into tests/faults/corpus
	$(BIN)/python -m tests.faults.fuzz --replay --seconds 600 --seed 1

mutants: $(READY)  ## small mistakes put into the code: which of them do the tests notice? An hour
	$(BIN)/python -m tests.mutants

check-oldest:  ## the oldest versions that pyproject.toml allows, in an environment of their own: tests of reading to predicting
	rm -rf build/oldest && $(PYTHON) -m venv build/oldest
	build/oldest/bin/python -m pip install --quiet --upgrade pip "setuptools>=77" wheel
	build/oldest/bin/python -m pip install --quiet --no-build-isolation -c constraints-oldest.txt \
		-e ".[diffusion,ros,excel,hdf5,dask]" "pytest>=8" "hypothesis>=6"
	build/oldest/bin/python -m pytest -W default -W ignore::DeprecationWarning $(OLDEST)

$(TOOLS): constraints.txt
	$(PYTHON) -m venv build/tools
	build/tools/bin/python -m pip install --quiet -c constraints.txt pip-audit cyclonedx-bom
	touch $@

format: $(READY)
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(None if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed; set PYTHON=...")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip "setuptools>=77" wheel
	$(BIN)/python -m pip install --quiet --no-build-isolation -c constraints.txt -e ".[dev]"
	touch $@

$(WARM): $(READY) $(CODE)  # before the tests, whose two processes would else compile the same code
	$(BIN)/ballfg compile
	touch $@

clean:
	rm -rf $(VENV) build results *.egg-info .pytest_cache .mypy_cache .ruff_cache
