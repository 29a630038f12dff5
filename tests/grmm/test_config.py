import pytest
import torch

from express50.errors import ConfigError
from express50.head.load import load_head
from grmm import losses
from grmm.config import PLUS, PRESETS, SCALE_RANGE_MM, as_tables, from_tables, resolve
from grmm.fit import LOCALITY_T
from grmm.networks import Networks, Refinement


def test_paper_preset_has_the_papers_numbers():
    config = resolve("paper")
    model, loss = config.model, config.loss
    assert (model.n_g, model.z_id, model.z_exp, model.features) == (512, 512, 256, 32)
    assert model.shared_widths[-1] + model.z_exp == 512
    assert (losses.L1, loss.ssim, losses.PERCEPTUAL, loss.depth) == (0.8, 0.2, 0.04, 0.5)
    assert (loss.scale, loss.laplacian, loss.codes) == (0.1, 0.01, 0.001)
    assert (config.train.iterations, config.train.lr) == (250_000, 1e-4)
    assert (config.fit.locality, LOCALITY_T) == (0.1, 0.3)
    assert SCALE_RANGE_MM == (0.1, 10.0)
    assert (model.frame, model.identity_modes, model.refine_unshuffle) == ("head", 0, 1)
    assert (model.refine_alpha, config.train.warm_start, loss.displacement) == (False, False, 0)
    assert config.train.final_lr == 1.0
    fit = config.fit
    assert not (fit.texture_warm_start or fit.shuffle_directions)
    with torch.device("meta"):
        networks = Networks(model, load_head("procedural"), 2, 3)
    assert networks.refinement.enter[0].in_channels == 3 + 32 + 1  # colours, features, depth


@pytest.mark.parametrize("name", ["paper-plus", "small", "demo"])
def test_our_presets_have_what_we_add(name):
    tables = as_tables(resolve(name))
    for table, values in PLUS.items():
        assert values.items() <= tables[table].items()


def test_the_demos_refinement_sees_a_quarter_of_the_size():
    model = resolve("demo").model
    net = Refinement(inputs=4, widths=model.refine_widths, unshuffle=model.refine_unshuffle)
    sizes = []
    net.enter.register_forward_hook(lambda _, given, out: sizes.append(given[0].shape[2:]))
    assert net(torch.rand(4, 64, 96)).shape == (3, 64, 96)
    assert sizes == [(64 // 4, 96 // 4)]


@pytest.mark.parametrize("name", PRESETS)
def test_presets_survive_a_checkpoint(name):
    config = resolve(name)
    assert from_tables(as_tables(config)) == config


def test_assignments_stand_over_toml_over_preset(tmp_path):
    file = tmp_path / "run.toml"
    file.write_text("[train]\nlr = 0.5\niterations = 7\n")
    config = resolve("demo", file, ["train.lr=0.25", "model.refine_widths=[8]"])
    assert (config.train.lr, config.train.iterations) == (0.25, 7)
    assert config.model.refine_widths == (8,)
    assert config.train.final_lr == resolve("demo").train.final_lr


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("model.ng=3", "did you mean 'n_g'"),
        ("modle.n_g=3", "did you mean 'model'"),
        ("model.n_g=100", "expected a multiple of 16"),
        ("train.iterations=0", "expected 1 or more"),
        ("model.frame=tangant", "expected one of head, tangent"),
        ("train.lr=fast", "expected a number"),
        ("model.identity_modes=99", "at most z_id"),
        ("model.identity_modes=-1", "expected 0 or more"),
        ("model.z_id=0", "expected 1 or more"),
        ("model.refine_unshuffle=0", "expected 1 or more"),
        ("model.refine_widths=[8, 0]", "expected widths of 1 or more"),
        ("train.evaluate_images=0", "expected 1 or more"),
        ("train.seed=-1", "expected 0 to "),
        ("fit.stage2_iterations=-1", "expected 0 or more"),
    ],
)
def test_bad_values_are_named(assignment, message):
    with pytest.raises(ConfigError, match=message):
        resolve("demo", None, [assignment])


def test_unknown_preset_and_missing_file_are_named(tmp_path):
    with pytest.raises(ConfigError, match="paper, paper-plus, small, demo"):
        resolve("dmeo")
    with pytest.raises(ConfigError, match="no such file"):
        resolve("demo", tmp_path / "absent.toml")
