# A thin door: CMake (CMakePresets.json) builds C and C++, pip builds the Python package, the tests run themselves.
#
#   make demo     a whole survey, simulated, through the daemon and the link, to build/demo/index.html
#   make test     everything that needs no special data
#   make hil      the daemon on an emulated arm64 board with Debian's kernel (part of make test)
#   make build    pipefishd and friends in build/release, the `pipefish` command in build/venv/bin
#   make bench    figures into build/bench.json (ONLY=track for some of them)
#   make accept   the long tests, resumable, into build/accept.json
#   make size     flash, RAM and stack of the core's rooms on Cortex-M
#   make format   lays the code out;  make clean   removes build/

SHELL := /bin/sh
MAKEFLAGS += --no-print-directory
VENV := build/venv
PY := $(VENV)/bin/python
STAMP := build/stamp
DEB := build/deb
FUZZ_SECONDS := 60
UNITY_DIR = $(abspath $(wildcard $(VENV)/lib/python3*/site-packages/vyperling/c))
ENGINE_SOURCES := $(shell find lib host_tools/engine cmake CMakeLists.txt -type f)
CROSS = aarch64 cortex-m0 cortex-m4 cortex-m7
C_FILES = $(shell find lib drivers firmware host_tools/engine tests examples -name '*.[ch]' -o -name '*.[ch]pp')

.PHONY: build demo test bench peers accept deb deb-arm64 deb-built format clean packages-build packages-test packages-board native unit lint fuzz-build fuzz-smoke fuzz-coverage cross proof size pytest hil hil-halves

build: native $(STAMP)/python

demo: build
	@$(VENV)/bin/pipefish demo --out build/demo

test: build lint unit fuzz-smoke proof cross pytest hil
	@echo "all tests passed"

packages-build:
	@tools/install-packages build

packages-test:
	@tools/install-packages build test

packages-board:
	@tools/install-packages build test board

native: packages-build
	@test -f build/release/build.ninja || cmake --preset release
	@cmake --build --preset release

# The virtual environment; made anew when what goes into it changes.
$(STAMP)/venv: pyproject.toml tools/requirements.txt tools/make-venv | packages-build
	@tools/make-venv $(VENV) tools/requirements.txt
	@mkdir -p $(STAMP) && touch $@

# What the benchmarks compare with: never a part of the product.
$(STAMP)/venv-peers: tools/requirements-peers.txt tools/make-venv | packages-build
	@tools/make-venv build/venv-peers $<
	@mkdir -p $(STAMP) && touch $@

# The package is installed in place: only a change of C, C++ or CMake builds it again.
$(STAMP)/python: $(STAMP)/venv $(ENGINE_SOURCES) pyproject.toml
	@$(PY) -m pip install --quiet --no-build-isolation --no-deps -e .
	@touch $@

unit: packages-test $(STAMP)/venv
	@test -f build/debug/build.ninja || cmake --preset debug -DUNITY_DIR=$(UNITY_DIR)
	@cmake --build --preset debug
	@ctest --preset debug

lint: packages-test $(STAMP)/venv
	@clang-format --dry-run --Werror $(C_FILES)
	@$(VENV)/bin/ruff check --quiet . && $(VENV)/bin/ruff format --check --quiet .

# Every parser and state machine for FUZZ_SECONDS, two at a time, from the inputs in tests/fuzz/corpus on, under clang with
# sanitizers; `make accept` runs longer, and keeps what it finds.
fuzz-build: packages-test
	@test -f build/clang/build.ninja || cmake --preset clang
	@cmake --build --preset clang

fuzz-smoke: fuzz-build
	@ls build/clang/tests/fuzz | grep '^fuzz_[a-z0-9_]*$$' | xargs -n 1 -P 2 tests/fuzz/smoke $(FUZZ_SECONDS) build/clang/tests/fuzz

# The protocols, in every state that small bounds reach (tests/proof).
proof: packages-test
	@tests/proof/prove build/proof

# The same bits everywhere: one hash per room, under every compiler, set of flags and target (docs/targets.md).
cross: unit fuzz-build
	@build/clang/tests/hashes/hashes >/dev/null || { build/clang/tests/hashes/hashes; exit 1; }
	@cmake --build build/debug --target run_hashes_O0 run_hashes_O2 run_hashes_O3
	@for p in $(CROSS); do \
	    test -f build/$$p/build.ninja || cmake --preset $$p -DUNITY_DIR=$(UNITY_DIR) || exit 1; \
	    cmake --build build/$$p || exit 1; ctest --preset $$p || exit 1; done

# Flash, RAM and stack of each room on the Cortex-M boards, as a table.
size: cross
	@tools/size-table $(filter cortex-%,$(CROSS))

pytest: build packages-test
	@$(PY) -m pytest -q -n 2 --dist loadfile

# Needs 400 MB of Debian packages once, kept in build/board. Without a network, or on a system that is not Debian 12, the
# scenarios are skipped and say so. An emulated board keeps one core busy: two halves at once.
hil: build deb-arm64
	@$(MAKE) hil-halves

# Alone: for what is built already. Each half adds its rows to build/hil/summary.json.
hil-halves:
	@mkdir -p build/hil; rm -f build/hil/summary*.json; $(PY) -m pytest -q tests/hil --half 2 >build/hil/log-2 2>&1 & other=$$!; \
	$(PY) -m pytest -q tests/hil --half 1; code=$$?; wait $$other || code=1; cat build/hil/log-2; exit $$code

peers: build $(STAMP)/venv-peers
	@tools/install-packages bench
	@test -f build/peers/build.ninja || cmake --preset peers
	@cmake --build --preset peers

bench: peers
	@$(PY) tests/bench/run.py --out build/bench.json $(if $(ONLY),--only $(ONLY))

# Debian packages in build/deb: the daemon, the C library and the host tools for this machine; the daemon and the library
# for 64-bit ARM boards too, cross-compiled.
deb: build deb-arm64
	@$(MAKE) deb-built
	@ls $(DEB)/*.deb

# Alone: those for this machine, of what is built already (tests/python/test_packaging.py).
deb-built:
	@$(call cpack,release)
	@$(PY) tools/host-package $(DEB) >/dev/null

deb-arm64: packages-board
	@if [ "$$(uname -m)" = aarch64 ]; then exit 0; fi; \
	if tools/board-image; then \
	    { test -f build/arm64/build.ninja || cmake --preset board; } && cmake --build --preset board && $(call cpack,arm64); \
	else \
	    echo "NO PACKAGES FOR arm64: they need Debian's, over the network"; \
	fi

cpack = mkdir -p $(DEB) && (cd build/$(1) && cpack --config CPackConfig.cmake -B $(abspath $(DEB)) \
	-D CPACK_VERBOSE=0 >$(abspath $(DEB))/log) || { cat $(DEB)/log; exit 1; }; rm -rf $(DEB)/_CPack_Packages

# The fuzz targets once more, counting the lines that their inputs reach.
fuzz-coverage: packages-test
	@tools/install-packages accept
	@test -f build/coverage/build.ninja || cmake --preset coverage
	@cmake --build --preset coverage

accept: build unit fuzz-build fuzz-coverage cross peers
	@$(PY) tests/accept.py --out build/accept.json

format: packages-test $(STAMP)/venv
	@clang-format -i $(C_FILES)
	@$(VENV)/bin/ruff check --quiet --fix . ; $(VENV)/bin/ruff format --quiet .

clean:
	@rm -rf build
