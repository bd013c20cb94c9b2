"""The table of methods counts what there is."""

from click.testing import CliRunner

from benchmarks import methods


def test_parameters_are_counted_without_compiling_anything():
    result = CliRunner().invoke(methods.main, ["--counts", "--size", "1m", "--size", "12m", "--method", "dreamerpro"])
    assert result.exit_code == 0, result.output
    lines = [line.split() for line in result.output.splitlines()]
    assert [line for line in lines if line[0] == "parameters"][1][2] == "12m,"
    header, row = lines[-2], lines[-1]
    counted = dict(zip(header, row, strict=True))
    assert (counted["total"], counted["target"], counted["objective"]) == ("9416907", "253216", "194752")
