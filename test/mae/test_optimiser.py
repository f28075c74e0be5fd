# SPDX-License-Identifier: Apache-2.0

import pytest
import torch

from musculoskeletal_ae.mae.optimiser import MATRIX_RATIO, Optimiser, orthogonal


@pytest.mark.parametrize('shape', [(4, 9), (9, 4), (1, 3), (300, 700), (700, 300)])
def test_orthogonalised_matrix_has_singular_values_near_one(shape):
    matrix = torch.randn(shape, generator=torch.Generator().manual_seed(0))
    singular = torch.linalg.svdvals(orthogonal(matrix))
    assert (singular - 1.0).abs().max() < 0.15
    assert torch.equal(orthogonal(torch.zeros(shape)), torch.zeros(shape))


def stepped(muon):
    """Return by how much one optimiser step of size 0.01 reduces a layer's weight and bias.

    With `muon`, the optimiser uses the Muon method for the weight.
    """
    layer = torch.nn.Linear(3, 2)
    before = [parameter.detach().clone() for parameter in layer.parameters()]
    optimiser = Optimiser(layer, 0.01, muon)
    layer(torch.tensor([[1.0, 2.0, -3.0]])).sum().backward()
    optimiser.step()
    assert all(p.grad is None for p in layer.parameters())
    return [old - new.detach() for old, new in zip(before, layer.parameters(), strict=True)]


def test_adam_steps_every_entry_by_its_step_size():
    for change in stepped(muon=False):
        torch.testing.assert_close(change.abs(), torch.full_like(change, 0.01), rtol=1e-3, atol=0.0)


def test_muon_steps_a_matrix_by_an_orthogonal_one_and_leaves_the_bias_to_adam():
    weight, bias = stepped(muon=True)
    size = torch.linalg.svdvals(weight)[0] / (0.01 * MATRIX_RATIO)
    assert size == pytest.approx(1.0, abs=0.15)
    torch.testing.assert_close(bias, torch.full_like(bias, 0.01), rtol=1e-3, atol=0.0)
