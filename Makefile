# Builds, tests and shows manylights in a virtual environment of its own. What the machine
# must have: Python 3.9 or later with venv, a C++17 compiler, make. Type `make help`.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
PIP    := $(BIN)/python -m pip --disable-pip-version-check

# Extra arguments for pytest, as in: make test ARGS="-k tree -x"
ARGS ?=

# One process of tests for each core; which test runs where makes no difference.
# In this one, to see output at once or for a debugger: make test ARGS="-n 0 -s -k tree"
IN_PARALLEL := -n auto --maxprocesses 8 --dist worksteal

# Object files stay here between builds. Ninja uses all cores; to use fewer, set the
# environment variable CMAKE_BUILD_PARALLEL_LEVEL.
BUILD_DIR := build/make

SOURCES  := CMakeLists.txt pyproject.toml \
            $(shell find ext plugins python/manylights -type f -not -name '*.pyc')
CPP_DIRS := $(wildcard ext plugins tests)

# The package is installed again when a source file or the choice of variants changes: the
# name of the stamp has a checksum of that choice.
VARIANTS_ID := $(shell printf '%s' "$$MANYLIGHTS_VARIANTS" | cksum | cut -d ' ' -f 1)
INSTALLED   := $(VENV)/.installed-$(VARIANTS_ID)

# What `make demo` needs, so that it does not wait for the others. Where all are there already,
# or where somebody chose, it takes those.
DEMO_VARIANTS  := scalar_rgb,llvm_ad_rgb
DEMO_INSTALLED := $(if $(MANYLIGHTS_VARIANTS)$(wildcard $(INSTALLED)),$(INSTALLED),$(VENV)/.installed-demo)

.PHONY: help
help:  ## Show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile | expand -t 23

.PHONY: demo
demo: $(DEMO_INSTALLED)  ## Render a city with more than 10,000 lights to demo.exr and demo.png
	$(BIN)/manylights demo -o demo

.PHONY: build
build: $(INSTALLED)  ## Compile the plugins and install the package into .venv

# Its objects are not those of other builds, which need not have all variants.
.PHONY: wheel
wheel: $(VENV)/.wheel-tools  ## Build a wheel with all variants into dist/, and try it out
	@echo "Compiling the plugins for all variants. The first time takes some minutes."
	@rm -rf build/wheel/built && mkdir -p dist
	MANYLIGHTS_WHEEL=1 $(PIP) wheel --quiet --no-build-isolation --no-deps \
	  -C build-dir=build/wheel/objects --wheel-dir build/wheel/built .
	PATH="$(abspath $(BIN)):$$PATH" ext/repair-wheel build/wheel/built/*.whl dist
	$(BIN)/python tests/try_wheel.py "$$(ls -t dist/*.whl | head -n 1)" $(ARGS)

.PHONY: test
test: $(INSTALLED)  ## Run the quick tests
	$(BIN)/python -m pytest $(IN_PARALLEL) $(ARGS)

.PHONY: test-slow
test-slow: $(INSTALLED)  ## Run the long tests, mostly statistics over many renders
	MANYLIGHTS_TEST_OPTIMIZED=1 $(BIN)/python -m pytest $(IN_PARALLEL) -m slow $(ARGS)

# Other seeds and variants: make soak ARGS="2000 --seed 50000 --variant llvm_ad_rgb"
.PHONY: soak
soak: $(INSTALLED)  ## Render 10,000 random scenes in child processes: no crash, no hang, no NaN
	$(BIN)/python -m tests.soak $(ARGS)

# Another build, beside the usual one. What it finds ends the process, so that its report must
# not be kept by pytest; memory is not given back at once and cannot be watched. Tests of means
# are left out: they render the scenes that test_robust.py renders, hundreds of times.
SANITIZED_TESTS := $(addprefix tests/test_,tree.py resampling.py counts.py determinism.py \
                   scene_updates.py robust.py) -k "not memory and not mean"

.PHONY: test-sanitized
test-sanitized: $(INSTALLED)  ## Run tests with checks of memory access and undefined behaviour (GCC)
	MANYLIGHTS_VARIANTS=scalar_rgb,scalar_spectral $(PIP) install --quiet --upgrade \
	  --no-deps --no-build-isolation --target build/sanitized/site \
	  -C build-dir=build/sanitized/objects -C cmake.build-type=RelWithDebInfo \
	  -C cmake.define.MANYLIGHTS_SANITIZE=ON .
	LD_PRELOAD="$$($${CXX:-c++} -print-file-name=libasan.so) \
	  $$($${CXX:-c++} -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	  DRJIT_LIBLLVM_PATH=/nonexistent PYTHONPATH=$(abspath build/sanitized/site) \
	  $(BIN)/python -m pytest --capture=sys $(SANITIZED_TESTS) $(ARGS)

# Counted are the lines that scalar variants run: others make kernels of them, which LLVM compiles.
COVERED_TESTS := $(patsubst %,tests/test_%.py,tree resampling sobol counts aovs light_groups plans \
                   state scene_updates determinism shadow_rays lamps_in_view unsampled_lights \
                   python_emitters textured_lights bad_input beams_in_fog light_closed_forms \
                   media_closed_forms path_closed_forms) -k "scalar or not (llvm or memory)"

# On a full disk children cannot write what they have run.
.PHONY: coverage
coverage: $(INSTALLED) $(VENV)/.coverage-tools  ## Count the lines that tests run: Python (all quick ones), C++ (some, scalar)
	$(BIN)/python -m pytest $(IN_PARALLEL) --cov --cov-report= -k "not full_disk" $(ARGS)
	$(BIN)/coverage report --skip-covered --sort=cover
	find build/coverage -name '*.gcda' -delete 2>/dev/null || true
	CXXFLAGS="-O2 -DNDEBUG --coverage -fprofile-update=atomic" MANYLIGHTS_VARIANTS=scalar_rgb,scalar_spectral \
	  $(PIP) install --quiet --upgrade --no-deps --no-build-isolation --target build/coverage/site \
	  -C build-dir=build/coverage/objects -C cmake.build-type=None .
	DRJIT_LIBLLVM_PATH=/nonexistent PYTHONPATH=$(abspath build/coverage/site) \
	  $(BIN)/python -m pytest $(IN_PARALLEL) $(COVERED_TESTS) $(ARGS)
	$(BIN)/gcovr --root . --filter plugins/ --merge-lines --sort uncovered-percent \
	  --gcov-ignore-parse-errors=suspicious_hits.warn_once_per_file build/coverage/objects

# Without HOME nothing is taken from Dr.Jit's cache on disk: first renders compile.
.PHONY: bench
bench: $(INSTALLED)  ## Measure all methods on the standard scenes (an hour) into bench/
	env -u HOME $(BIN)/manylights bench --standard --out bench $(ARGS)
	$(BIN)/manylights report bench

.PHONY: bench-quick
bench-quick: $(INSTALLED)  ## The same on a few small scenes (5 minutes)
	env -u HOME $(BIN)/manylights bench --quick --out bench-quick $(ARGS)
	$(BIN)/manylights report bench-quick

.PHONY: microbench
microbench: $(INSTALLED) $(VENV)/.dev-tools  ## Time building, traversal and resampling alone (a minute) into microbench.json
	MANYLIGHTS_TEST_OPTIMIZED=1 $(BIN)/python -m pytest tests/bench_tree.py --benchmark-json=microbench.json $(ARGS)

# All anew, in seconds: Sphinx does not see that a parser or the list of pages has changed.
.PHONY: docs
docs: $(DEMO_INSTALLED) $(VENV)/.docs-tools  ## Build the documentation into build/docs/html
	$(BIN)/python -m sphinx -W --keep-going -q -E -a -d build/docs/doctrees python/docs build/docs/html

.PHONY: lint
lint: $(VENV)/.dev-tools  ## Check style and common mistakes, without compiling
	$(BIN)/ruff check python tests
	$(BIN)/ruff format --check python tests
	find $(CPP_DIRS) -name '*.h' -o -name '*.cpp' | xargs -r $(BIN)/clang-format --dry-run -Werror

.PHONY: format
format: $(VENV)/.dev-tools  ## Rewrite the sources in the style that lint checks
	$(BIN)/ruff check --fix python tests
	$(BIN)/ruff format python tests
	find $(CPP_DIRS) -name '*.h' -o -name '*.cpp' | xargs -r $(BIN)/clang-format -i

.PHONY: clean
clean:  ## Delete everything that was built, .venv too
	rm -rf build dist $(VENV) .cache .pytest_cache .ruff_cache .hypothesis demo.exr demo.png bench bench-quick microbench.json
	find python tests -name __pycache__ -type d -prune -exec rm -rf {} +

# pip 25.1 is the first that can install the dependency groups of pyproject.toml.
$(VENV)/.created:
	@PYTHON="$(PYTHON)" ext/missing-packages tools
	@$(PYTHON) -m venv $(VENV) || $(PYTHON) -m virtualenv $(VENV) || { rm -rf $(VENV); exit 1; }
	$(PIP) install --quiet --upgrade 'pip>=25.1'
	@touch $@

$(VENV)/.coverage-tools: pyproject.toml | $(VENV)/.created
	$(PIP) install --quiet --group coverage
	@touch $@

$(VENV)/.dev-tools: pyproject.toml | $(VENV)/.created
	$(PIP) install --quiet --group dev
	@touch $@

# Asked before the virtual environment is made, which has its own package.
build/.system-packages: ext/missing-packages
	@PYTHON="$(PYTHON)" ext/missing-packages build
	@mkdir -p build && touch $@

$(VENV)/.build-tools: pyproject.toml | build/.system-packages $(VENV)/.created
	$(PIP) install --quiet --group build
	@touch $@

$(VENV)/.docs-tools: pyproject.toml | $(VENV)/.created
	$(PIP) install --quiet --group docs
	@touch $@

$(VENV)/.wheel-tools: $(VENV)/.build-tools
	$(PIP) install --quiet --group wheel
	@touch $@

# Without build isolation the paths of the headers stay the same, and with them the objects.
INSTALL := $(PIP) install --quiet --no-build-isolation -C build-dir=$(BUILD_DIR)

$(INSTALLED): $(VENV)/.build-tools $(SOURCES)
	@echo "Compiling the plugins. The first time takes some minutes."
	$(INSTALL) -C cmake.define.MANYLIGHTS_BINDINGS=ON '.[test,bench]'
	@rm -f $(VENV)/.installed-* && touch $@

$(VENV)/.installed-demo: $(VENV)/.build-tools $(SOURCES)
	@echo "Compiling the plugins for $(DEMO_VARIANTS). The first time takes a minute or two."
	MANYLIGHTS_VARIANTS=$(DEMO_VARIANTS) $(INSTALL) -C cmake.define.MANYLIGHTS_BINDINGS=OFF .
	@rm -f $(VENV)/.installed-* && touch $@
