"""A person who waits for a compiler is told so, once for each part."""

import logging

import pytest

from sonotwin import first_use


@pytest.fixture
def log(monkeypatch) -> logging.Logger:
    """The compiler's log, as it is outside tests."""
    log = logging.getLogger("recon.compiled")
    monkeypatch.setattr(log, "handlers", [])
    monkeypatch.setattr(log, "level", logging.NOTSET)
    monkeypatch.setattr(log, "disabled", False)
    log.manager._clear_cache()
    yield log
    log.manager._clear_cache()


def test_a_part_is_announced_once(log, capsys):
    first_use.announce()
    first_use.announce()
    for module in ("recon.structured_light.decode", "recon.structured_light.phase", "twin.sensor", "twin.ultrasound.medium"):
        log.info("compiling %s.%s, once", module, "kernel")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert [" ".join(line.split()[:4]) for line in captured.err.splitlines()] == [
        "compile decoder and mesh,",
        "compile the rendered sensor,",
        "compile the rendered scanner,",
    ]


def test_a_wait_for_another_process_is_no_compiling(log, capsys):
    first_use.announce()
    for module in ("recon.structured_light.decode", "recon.structured_light.phase"):
        log.info("waiting for another process that compiles %s.%s", module, "kernel")
    log.info("compiling %s.%s, once", "recon.structured_light.decode", "kernel")
    first, second = capsys.readouterr().err.splitlines()
    assert first == "wait        for another process that compiles the decoder and mesh"
    assert second.startswith("compile     decoder and mesh,")


def test_every_compiled_module_belongs_to_a_part(log, capsys, request):
    """So that none is compiled in silence."""
    root = request.config.rootpath
    sources = [path for package in ("recon", "twin") for path in (root / package).rglob("*.py")]
    modules = [".".join(path.relative_to(root).with_suffix("").parts) for path in sources if "@njit" in path.read_text("utf-8")]
    assert len(modules) > 20
    for module in modules:
        first_use.announce()
        log.info("compiling %s.%s, once", module, "kernel")
        assert capsys.readouterr().err.startswith("compile "), module
        log.handlers.clear()
        log.setLevel(logging.NOTSET)


def test_tests_are_quiet(capsys):
    first_use.announce()
    logging.getLogger("recon.compiled").info("compiling %s.%s, once", "recon.structured_light.decode", "kernel")
    assert capsys.readouterr().err == ""
