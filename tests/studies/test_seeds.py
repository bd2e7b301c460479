from studies.seeds import CONDITIONS, FIGURES, means, row_of


def test_the_mean_is_over_networks_for_each_condition_and_figure():
    tables = {
        name: {"rows": {"a": dict.fromkeys(FIGURES, 1.0) | {"other": 5.0}, "b": dict.fromkeys(FIGURES, 2.0 + place)}}
        for place, name in enumerate(CONDITIONS)
    }
    mean = means([row_of(tables, "a"), row_of(tables, "b")])
    assert [mean[name]["mse"] for name in CONDITIONS] == [1.5, 2.0, 2.5]
    assert set(mean["measured"]) == set(FIGURES)
