"""The table of methods counts what there is."""

import pytest
from click.testing import CliRunner

from benchmarks import methods


def test_parameters_are_counted():
    result = CliRunner().invoke(methods.main, ["--counts", "--size", "1m", "--size", "12m", "--method", "dreamerpro"])
    assert result.exit_code == 0, result.output
    lines = [line.split() for line in result.output.splitlines()]
    assert [line[3] for line in lines if line[0] == "preset"] == ["1m,", "12m,"]
    header, row = lines[-2], lines[-1]
    counted = dict(zip(header, row, strict=True))
    assert (counted["total"], counted["target"], counted["objective"]) == ("9416907", "253216", "194752")


def test_methods_get_the_settings_that_they_have():
    plain = methods._configs("laptop", None, methods.METHODS, None, ())
    given = ("agent.objective.predictor.width=128", "agent.behavior.horizon=3")
    changed = methods._configs("laptop", None, methods.METHODS, None, given)
    assert changed["ne_dreamer"].agent.objective.predictor.width == 128
    assert changed["dreamerv3"].agent.behavior.horizon == 3
    assert changed["drqv2"] == plain["drqv2"]
    with pytest.raises(ValueError, match="no setting is called"):
        methods._configs("laptop", None, methods.METHODS, None, ("agent.behaviour.horizon=3",))
