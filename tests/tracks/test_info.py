import numpy as np
import pytest

from ballfg.checks import MAX_LISTED
from ballfg.tracks import TABLE_TENNIS, Ball, read_dataset
from ballfg.tracks.info import TENNIS, DatasetInfo, read_info, write_info

GOOD = {
    "name": "name: small",
    "frame": "frame: {up: z, table_height: 0.76}",
    "ball": "ball: {radius: 0.02, mass: 0.0027}",
}


def _yaml(**changes: str) -> str:
    return "\n".join(line for line in (GOOD | changes).values() if line) + "\n"


def _table(ends: str) -> str:
    return _yaml(frame=f"frame: {{up: z, table_height: 0.76, table: {ends}}}")


def test_presets_are_si():
    assert (TABLE_TENNIS.radius, TABLE_TENNIS.mass) == (0.02, 0.0027)
    assert (TENNIS.radius, TENNIS.mass) == (0.0335, 0.0577)


def test_optional_fields_default_to_none(make_folder):
    info = read_dataset(make_folder(yaml=_yaml())).info
    assert info == DatasetInfo("small", 0.76, TABLE_TENNIS)
    assert info.rate is info.position_noise is info.spin_noise is info.source is info.licence is None


def test_all_fields_are_read(make_folder):
    text = _yaml(rest="rate: 100\nposition_noise: 0.002\nspin_noise: 5\nsource: lab\nlicence: MIT\nlabels: {a: b}")
    dataset = read_dataset(make_folder(yaml=text))
    assert dataset.info == DatasetInfo("small", 0.76, TABLE_TENNIS, 100.0, 0.002, 5.0, "lab", "MIT")
    assert dataset.notes == []


def test_the_ends_of_the_table_are_read_and_written(make_folder, tmp_path):
    frame = "frame: {up: z, table_height: 0.76, table: {x: [-1.37, 1.37], y: [0, 1.525]}}"
    dataset = read_dataset(make_folder(yaml=_yaml(frame=frame)))
    assert dataset.info.table_extent == (-1.37, 1.37, 0.0, 1.525)
    assert dataset.notes == []
    write_info(tmp_path / "dataset.yaml", dataset.info)
    assert read_info(tmp_path / "dataset.yaml") == (dataset.info, [])


def test_a_dataset_without_a_surface(make_folder, tmp_path):
    dataset = read_dataset(make_folder(yaml=_yaml(frame="frame: {up: z, table_height: none}")))
    assert dataset.info.table_height is None
    assert dataset.table == -np.inf
    write_info(tmp_path / "dataset.yaml", dataset.info)
    assert "table_height: none" in (tmp_path / "dataset.yaml").read_text()
    assert read_info(tmp_path / "dataset.yaml") == (dataset.info, [])


@pytest.mark.parametrize(
    ("frame", "rule"),
    [
        ("{up: z, table_height: null}", "frame.table_height is required"),
        ("{up: z, table_height: }", "nothing stands after 'table_height:'. Write its value there, or none where balls"),
        ("{up: , table_height: 0}", "frame.up is required; nothing stands after 'up:'. Write its value there."),
        ("{up: z, table_height: nothing}", "frame.table_height must be a number"),
        ("{up: z, table_height: none, table: {x: [0, 2], y: [0, 1]}}", "frame.table must be absent"),
    ],
)
def test_a_height_that_is_neither_a_number_nor_none(make_folder, frame, rule):
    with pytest.raises(ValueError, match=rule):
        read_dataset(make_folder(yaml=_yaml(frame=f"frame: {frame}")))


def test_unknown_fields_are_noted_with_the_nearest_name(make_folder):
    dataset = read_dataset(make_folder(yaml=_yaml(rest="position_nois: 0.002\ncolour: white")))
    assert dataset.info.position_noise is None
    assert dataset.notes == [
        "dataset.yaml: field 'position_nois' ignored. Did you mean 'position_noise'?",
        "dataset.yaml: field 'colour' ignored",
    ]


def test_unknown_fields_of_sections_are_noted_too(make_folder):
    frame, ball = "{up: z, table_height: 0.0, tabel: {x: [0, 1]}}", "{radius: 0.02, mass: 0.0027, colour: white}"
    dataset = read_dataset(make_folder(yaml=_yaml(frame=f"frame: {frame}", ball=f"ball: {ball}")))
    assert dataset.notes == [
        "dataset.yaml: field 'frame.tabel' ignored. Did you mean 'table'?",
        "dataset.yaml: field 'ball.colour' ignored",
    ]


@pytest.mark.parametrize(
    "wrong", [{"frame": "frame: {up: z, table_height: 0,76}"}, {"ball": "ball: {radius: 0,02, mass: 0.0027}"}]
)
def test_a_decimal_comma_is_no_height_of_zero(make_folder, wrong):
    with pytest.raises(ValueError, match="decimal point"):
        read_dataset(make_folder(yaml=_yaml(**wrong)))


def test_of_many_unknown_fields_the_first_are_named(make_folder):
    dataset = read_dataset(make_folder(yaml=_yaml(rest="\n".join(f"own_{k}: {k}" for k in range(MAX_LISTED + 3)))))
    assert len(dataset.notes) == MAX_LISTED + 1
    assert dataset.notes[-1] == "dataset.yaml: 3 more fields ignored"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (_yaml(name=""), "name is required; got frame, ball. Add it."),
        (_yaml(name="names: a"), "name is required; got names, frame, ball. Add it, or rename 'names'."),
        (_yaml(name="name: 17"), "name must be text; got int 17. Put it in quotes."),
        (_yaml(name="name: ' '"), "name must be printable text of one line, "),
        (_yaml(frame=""), "frame is required; got name, ball."),
        (_yaml(frame="frame: z"), "frame must be a mapping with up and table_height; got 'z'. Write frame: {up: ..."),
        (_yaml(frame="frame: {up: y, table_height: 0}"), "frame.up must be 'z', the only up axis that is supported"),
        (
            _yaml(frame="frame: {up: z, tabel_height: 0}"),
            "frame.table_height is required; got up, tabel_height. Add it",
        ),
        (
            _yaml(frame="frame: {up: z, table_height: 760}"),
            "frame.table_height must be in m, at most 50; got 760. It is",
        ),
        (
            _yaml(frame="frame: {up: z, table_height: high}"),
            "frame.table_height must be a number in m; got str 'high'.",
        ),
        (
            _table("[0, 2.74]"),
            "frame.table must be a mapping with x and y; got [0, 2.74]. Write table: {x: [0.0, 2.74]",
        ),
        (_table("{x: [0, 2.74]}"), "frame.table.y is required; got x. Add it."),
        (_table("{x: 2.74, y: [0, 1]}"), "frame.table.x must be two numbers in m, the table's ends along x; got 2.74."),
        (_table("{x: [0, 1, 2], y: [0, 1]}"), "got [0, 1, 2]. Write x: [low, high]."),
        (_table("{x: [2.74, 0], y: [0, 1]}"), "frame.table.x must increase; got [2.74, 0]. Give the lower end first."),
        (_table("{x: [0, 1], y: [1, 1]}"), "frame.table.y must increase; got [1, 1]."),
        (_table("{x: [0, .inf], y: [0, 1]}"), "frame.table.x must be finite; got inf. Correct it (unit: m)."),
        (_table("{x: [0, .nan], y: [0, 1]}"), "frame.table.x must be finite; got nan."),
        (_table("{x: [0, long], y: [0, 1]}"), "frame.table.x must be a number in m; got str 'long'."),
        (
            _table("{x: [0, 2740], y: [0, 1525]}"),
            "frame.table.x must be in m, at most 1000; got 2740. It is probably in mm",
        ),
        (_table("{x: [0, 274], y: [0, 153]}"), "frame.table.x must be in m, its ends 0.1 to 50 m apart; got [0, 274]."),
        (_table("{x: [0, 0.01], y: [0, 1]}"), "its ends 0.1 to 50 m apart; got [0, 0.01]. Convert it to m."),
        (
            _yaml(ball="ball: {radius: 20, mass: 0.0027}"),
            "ball.radius must be in m, at most 0.5; got 20. It is probably",
        ),
        (
            _yaml(ball="ball: {radius: 0.02, mass: 2.7}"),
            "ball.mass must be in kg, at most 2; got 2.7. It is probably in g",
        ),
        (_yaml(ball="ball: {radius: 0, mass: 1}"), "ball.radius must be finite and above 0; got 0."),
        (_yaml(ball="ball: {radius: .nan, mass: 1}"), "ball.radius must be finite and above 0; got nan."),
        (_yaml(ball="ball: {radius: true, mass: 1}"), "ball.radius must be a number in m; got bool True."),
        (_yaml(ball="ball: {radius: 2e-2, mass: 1}"), "got str '2e-2'. Write it like 0.02 or 2.0e-2."),
        (_yaml(ball="ball: {radius: 0.02}"), "ball.mass is required; got radius. Add it."),
        (_yaml(rest="rate: -1"), "rate must be finite and above 0; got -1. Correct it (unit: Hz)."),
        (_yaml(rest="position_noise: 2"), "position_noise must be in m, at most 1; got 2. It is probably in mm"),
        (_yaml(rest="spin_noise: 0"), "spin_noise must be finite and above 0; got 0."),
        (_yaml(rest="source: 2024-01-01"), "source must be text; got date 2024-01-01. Put it in quotes."),
        ("", "must hold fields such as 'name: my_shots'; got nothing. Give at least name, frame, ball."),
        ("- a\n- b\n", "must hold fields such as 'name: my_shots'; got list."),
        ("name: [a\nframe: 1\n", ", line 2: must be valid YAML;"),
        ("name: a\n\tball: 1\n", ", line 2: must be valid YAML;"),
        ("a: !!python/object:os.system x\n", "must be valid YAML; values must be written without a tag"),
        (b"name: caf\xe9\n", "must be UTF-8 text;"),
        ("name: a\x01b\n", "must be valid YAML; control characters are not allowed"),
    ],
)
def test_a_bad_yaml_is_named(make_folder, text, message):
    folder = make_folder(yaml=text)
    with pytest.raises(ValueError, match=r".") as caught:
        read_dataset(folder)
    assert str(caught.value).startswith(str(folder / "dataset.yaml"))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_info_is_checked_without_a_file_too():
    with pytest.raises(TypeError, match="ball must be a Ball; got dict"):
        DatasetInfo("a", 0.0, {"radius": 0.02})
    with pytest.raises(TypeError, match="name must be text; got nothing None"):
        DatasetInfo(None, 0.0, TABLE_TENNIS)
    with pytest.raises(ValueError, match=r"ball\.radius must be finite and above 0; got -1"):
        Ball(-1, 0.1)
    with pytest.raises(TypeError, match=r"table_extent must be \(x_low, x_high, y_low, y_high\) in m; got \(0, 1\)"):
        DatasetInfo("a", 0.0, TABLE_TENNIS, table_extent=(0, 1))
