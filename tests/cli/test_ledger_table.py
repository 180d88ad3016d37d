"""The table of `calibray ledger`."""

import shown
from calibray.cli.doctor import calls_table
from calibray.tables import render


def test_the_table_has_one_row_per_call():
    calls = shown.calls()
    for name, table in (("ledger", calls), ("ledger-empty", calls.iloc[:0])):
        golden = (shown.GOLDEN / f"{name}.txt").read_text(encoding="utf-8").removesuffix("\n")
        assert render(calls_table(table)) == golden
