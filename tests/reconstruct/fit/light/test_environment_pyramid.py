"""The learned light."""

import torch

from drgs.reconstruct.fit.light.environment_pyramid import ENVIRONMENT_PYRAMID, environment_table


def test_the_environment_starts_even_and_its_coarse_tables_wrap_around():
    state_parameters = {f"environment_{rows}": torch.zeros(1, 3, rows, 2 * rows) for rows in ENVIRONMENT_PYRAMID}
    assert torch.equal(environment_table(state_parameters), torch.ones(128, 256, 3))
    rolled = dict(state_parameters)
    state_parameters["environment_8"] = torch.randn(1, 3, 8, 16)
    rolled["environment_8"] = torch.roll(state_parameters["environment_8"], 3, -1)
    torch.testing.assert_close(torch.roll(environment_table(state_parameters), 3 * 16, 1), environment_table(rolled))
    assert float(environment_table(state_parameters).min()) > 0
