"""What the library logs while a command runs."""

import logging

from vertiwm_jax import cli


def test_log_lines_are_printed_while_a_command_runs_and_not_after(capsys):
    log = logging.getLogger("vertiwm_jax.some.module")
    before = log.isEnabledFor(logging.INFO)
    with cli.told():
        log.info("placing %d vehicles", 3)
        log.debug("not shown")
    assert capsys.readouterr().out == "placing 3 vehicles\n"
    assert log.isEnabledFor(logging.INFO) == before
