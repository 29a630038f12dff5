import pytest
import torch

from grmm.config import ModelConfig
from grmm.networks import Ladder, MeshDecoder, Refinement, normalise_depth


def ladder(view_dependent=False, mode_outputs=None, **changes):
    config = ModelConfig(**({"n_g": 32, "seed_channels": 8, "ladder": (8, 8)} | changes))
    return Ladder(config, 6, 5, view_dependent, mode_outputs)


def mesh_decoder(teeth=None):
    config = ModelConfig(z_id=6, z_exp=4, shared_widths=(16, 8), film_width=8, mesh_width=8)
    return MeshDecoder(config, 7, torch.zeros(9, dtype=torch.bool) if teeth is None else teeth)


def test_ladder_starts_at_its_bias():
    net = ladder()
    with torch.no_grad():
        net.bias.copy_(torch.randn_like(net.bias))
    assert torch.equal(net(torch.randn(6)), net.bias)


@pytest.mark.parametrize(("n_g", "widths"), [(16, ()), (32, (8,)), (128, (16, 8, 8))])
def test_ladder_doubles_up_to_n_g(n_g, widths):
    assert ladder(n_g=n_g, ladder=widths)(torch.zeros(6)).shape == (5, n_g, n_g)


def test_paper_ladder_reaches_512_from_8():
    net = ladder(n_g=512, seed_channels=4, ladder=(4, 4, 4, 4, 4))
    assert net.seed_shape == (1, 4, 8, 8)
    assert len(net.doublings) + 1 == 6


def test_every_parameter_of_a_ladder_learns():
    net = ladder(identity_modes=2, view_dependent=True)
    torch.nn.init.normal_(net.last.weight)
    torch.nn.init.normal_(net.modes)
    net(torch.randn(6), torch.tensor([0.0, 0.6, 0.8])).square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in net.parameters())


def test_modes_are_linear_in_the_code():
    net = ladder(identity_modes=3)
    torch.nn.init.normal_(net.modes)
    code = torch.tensor([1.0, -2.0, 0.5, 9.0, 9.0, 9.0])
    expected = net.bias + net.modes[0] - 2 * net.modes[1] + 0.5 * net.modes[2]
    torch.testing.assert_close(net(code), expected)


def test_modes_may_reach_the_first_outputs_only():
    net = ladder(identity_modes=2, mode_outputs=3)
    torch.nn.init.ones_(net.modes)
    out = net(torch.ones(6))
    assert torch.equal(out[:3], net.bias[:3] + 2) and torch.equal(out[3:], net.bias[3:])


def test_activations_keep_their_size_through_the_ladder():
    torch.manual_seed(0)
    net = ladder(n_g=128, ladder=(32, 32, 32), seed_channels=32)
    x = torch.randn(1, 32, 8, 8)
    for doubling in net.doublings:
        x = doubling(x)
        assert 0.3 < float(x.detach().std()) < 3


def test_mesh_decoder_starts_at_rest_and_film_at_the_identity():
    net = mesh_decoder()
    arguments = [torch.randn(n) for n in (6, 4, 3, 3, 7)]
    assert all(torch.equal(part, torch.zeros(9, 3)) for part in net(*arguments))
    feature = torch.randn(12)
    assert torch.equal(net.modulate(feature, torch.randn(7)), feature)


def test_film_scales_and_shifts():
    net = mesh_decoder()
    with torch.no_grad():
        net.film[-1].bias.copy_(torch.cat([torch.full((12,), 0.5), torch.full((12,), -1.0)]))
    feature = torch.randn(12)
    torch.testing.assert_close(net.modulate(feature, torch.zeros(7)), 1.5 * feature - 1)


def test_teeth_get_no_expression_offset_but_an_identity_offset():
    teeth = torch.arange(9) < 4
    net = mesh_decoder(teeth)
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter)
    identity, expression = net(*(torch.randn(n) for n in (6, 4, 3, 3, 7)))
    assert torch.equal(expression[teeth], torch.zeros(4, 3))
    assert (expression[~teeth] != 0).all() and (identity != 0).all()


def test_expression_inputs_do_not_reach_the_identity_displacement():
    net = mesh_decoder()
    for parameter in net.parameters():
        torch.nn.init.normal_(parameter)
    z_id, neck, jaw = torch.randn(6), torch.randn(3), torch.randn(3)
    one = net(z_id, torch.randn(4), neck, jaw, torch.randn(7))
    two = net(z_id, torch.randn(4), neck, jaw, torch.randn(7))
    assert torch.equal(one[0], two[0]) and not torch.equal(one[1], two[1])


@pytest.mark.parametrize("unshuffle", [1, 2])
@pytest.mark.parametrize("size", [(16, 24), (17, 23), (1, 1)])
def test_refinement_starts_as_the_identity_at_any_size(size, unshuffle):
    net = Refinement(inputs=6, widths=(8, 12, 16), unshuffle=unshuffle)
    maps = torch.rand(6, *size)
    assert torch.equal(net(maps), maps[:3])


def test_activations_keep_their_size_through_the_refinement():
    torch.manual_seed(0)
    net = Refinement(inputs=6, widths=(24, 32, 48), unshuffle=1)
    torch.nn.init.normal_(net.head.weight, std=1 / (24 * 9) ** 0.5)
    maps = torch.rand(6, 32, 32)
    residual = (net(maps) - maps[:3]).detach()
    assert 0.1 < float(residual.std()) < 10


def test_every_parameter_of_the_refinement_learns():
    net = Refinement(inputs=5, widths=(8, 12), unshuffle=2)
    torch.nn.init.normal_(net.head.weight)
    net(torch.rand(5, 16, 16)).square().sum().backward()
    assert all(p.grad.abs().sum() > 0 for p in net.parameters())


def test_depth_normalisation_spans_covered_pixels_only():
    depth = torch.tensor([[0.0, 1.0], [1.2, 1.1]])
    alpha = torch.tensor([[0.2, 0.9], [0.9, 0.9]])
    expected = torch.tensor([[0.0, 0.0], [1.0, 0.5]])
    torch.testing.assert_close(normalise_depth(depth, alpha), expected)
