from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml
from safetensors.torch import load_file, save_file

from ballfg.learning.sequence.data import LauncherSettings, example
from ballfg.learning.sequence.predictor import SequenceArchitecture, SequenceKind, SequencePredictor
from ballfg.tracks import Track

LABELS = ("topspin", "sidespin", "speed")
kinds = pytest.mark.parametrize("kind", ["lstm", "diffusion"])


def predictor_of(
    kind: SequenceKind, tracks: list[Track], launcher: LauncherSettings | None = None
) -> SequencePredictor:
    launcher = LauncherSettings(LABELS) if launcher is None else launcher
    architecture = SequenceArchitecture(kind, 16)
    examples = [example(track, 25, launcher.of(track)) for track in tracks]
    return SequencePredictor(architecture, launcher, architecture.untrained(examples, seed=0))


@kinds
def test_saved_and_loaded_predicts_the_same_bits(kind: SequenceKind, tracks: list[Track], tmp_path: Path) -> None:
    predictor = predictor_of(kind, tracks)
    predictor.save(tmp_path / "model")
    loaded = SequencePredictor.load(tmp_path / "model")
    track = tracks[0]
    asked = track.times[25:] + 1e-3
    assert np.array_equal(loaded.predict(track, 25, asked), predictor.predict(track, 25, asked))
    assert loaded.parameter_count == predictor.parameter_count
    assert sorted(path.name for path in tmp_path.iterdir()) == ["model"]


def test_text_labels_are_kept(tracks: list[Track], tmp_path: Path) -> None:
    labelled = [
        Track(t.times, t.positions, labels={"group": "ab"[i % 2], "speed": t.labels["speed"]}, name=t.name)
        for i, t in enumerate(tracks)
    ]
    launcher = LauncherSettings(("group", "speed"), {"group": ("a", "b")})
    assert launcher.of(labelled[1]).tolist() == [0.0, 1.0, labelled[1].labels["speed"]]
    predictor_of("lstm", labelled, launcher).save(tmp_path / "model")
    assert SequencePredictor.load(tmp_path / "model").launcher == launcher


def test_many_are_predicted_as_one_by_one(tracks: list[Track]) -> None:
    predictor = predictor_of("lstm", tracks)
    observed = [20, 31, 25]
    asked = [track.times[count:][:: i + 1] for i, (track, count) in enumerate(zip(tracks, observed, strict=False))]
    many = predictor.predict_many(tracks[:3], observed, asked)
    for track, count, times, got in zip(tracks, observed, asked, many, strict=False):
        assert got.shape == (len(times), 3)
        np.testing.assert_allclose(got, predictor.predict(track, count, times), rtol=0, atol=1e-5)


def test_nothing_after_the_observed_part_is_used(tracks: list[Track]) -> None:
    predictor, track = predictor_of("diffusion", tracks), tracks[0]
    cut = Track(track.times[:25], track.positions[:25], labels=track.labels, name=track.name)
    asked = track.times[25:]
    assert np.array_equal(predictor.predict(cut, 25, asked), predictor.predict(track, 25, asked))


def test_a_track_without_settings_is_refused(tracks: list[Track]) -> None:
    track = Track(tracks[0].times, tracks[0].positions, name="bare")
    with pytest.raises(ValueError, match=r"labels of track 'bare' must be known launcher settings; got .*None"):
        predictor_of("lstm", tracks).predict(track, 25, track.times[25:])


def test_without_labels_observations_are_enough(tracks: list[Track]) -> None:
    predictor = predictor_of("lstm", tracks, LauncherSettings())
    bare = Track(tracks[0].times, tracks[0].positions, name="bare")
    assert np.isfinite(predictor.predict(bare, 25, bare.times[25:])).all()


def test_an_earlier_model_is_replaced_and_other_files_stay(tracks: list[Track], tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    for launcher in (LauncherSettings(LABELS), LauncherSettings()):
        predictor_of("lstm", tracks, launcher).save(tmp_path)
        assert SequencePredictor.load(tmp_path).launcher == launcher
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_missing_and_damaged_files_are_named(tracks: list[Track], tmp_path: Path) -> None:
    folder = tmp_path / "model"
    with pytest.raises(
        FileNotFoundError, match=r"must hold config.yaml and weights.safetensors; config.yaml is missing"
    ):
        SequencePredictor.load(folder)
    predictor_of("lstm", tracks).save(folder)
    config, weights = folder / "config.yaml", folder / "weights.safetensors"
    text, tensors = config.read_text(), load_file(weights)

    for wrong in ({"kind": "gru"}, {"width": 12}):
        config.write_text(yaml.safe_dump(yaml.safe_load(text) | wrong))
        with pytest.raises(ValueError, match=r"config.yaml: not the config of a sequence model"):
            SequencePredictor.load(folder)
    config.write_text(yaml.safe_dump(yaml.safe_load(text) | {"width": 24}))
    with pytest.raises(ValueError, match=r"weights in .* must be those of the model in its config; 'bridge.bias' is"):
        SequencePredictor.load(folder)
    config.write_text(text)
    save_file({name: value for name, value in tensors.items() if name != "frame.step"}, weights)
    with pytest.raises(ValueError, match=r"'frame.step' is missing"):
        SequencePredictor.load(folder)
    save_file(tensors | {"extra": torch.zeros(1)}, weights)
    with pytest.raises(ValueError, match=r"'extra' is .*, not part of it"):
        SequencePredictor.load(folder)
    save_file(tensors | {"bridge.bias": tensors["bridge.bias"] + 1e-9}, weights)
    with pytest.raises(ValueError, match=r"must be as it was saved, with the digest that config.yaml states"):
        SequencePredictor.load(folder)
    weights.write_bytes(b"not numbers")
    with pytest.raises(ValueError, match=r"weights.safetensors must be a whole safetensors file"):
        SequencePredictor.load(folder)
