"""Sparse identification of nonlinear dynamics, by the PySINDy library itself."""

from __future__ import annotations

import time
import warnings
from itertools import product

import numpy as np
import torch
from torch import Tensor

from baselines.learner import Learner

HELD = 5
"""Every so manieth row judges the settings."""


class Sindy(Learner):
    """Sparse polynomials of (sin α, cos α, q̇, F) for q̈; degree and threshold are chosen on rows held back.

    The plant's accelerations are rational (M⁻¹ holds 1/(j + m d² sin²α)), which no polynomial is exactly.
    """

    name = "PySINDy"
    citation = "Brunton, Proctor, Kutz (2016), PNAS 113, 3932; Kaptanoglu et al. (2022), JOSS 7, 3994"
    configuration = "STLSQ on polynomials of (sin α, cos α, α̇, i, v), degree 3 to 5, by validation"

    degrees = (3, 4, 5)
    thresholds = (1e-4, 1e-3, 1e-2, 1e-1)

    def build(self) -> None:
        """Nothing is there before the fit."""
        self.powers = torch.zeros(0)
        self.coefficients = torch.zeros(0)

    @property
    def size(self) -> int:
        """Number of terms that are left."""
        return int((self.coefficients != 0).sum())

    def acceleration(self, q: Tensor, v: Tensor, force: Tensor) -> Tensor:
        """The polynomials, from their exponents."""
        x = torch.cat([self.jet(q).value, v, force[:, self.inputs]], 1)
        return torch.prod(x[:, None] ** self.powers, 2) @ self.coefficients.T

    def fit(self, share: float = 1.0) -> float:
        """Fit for each setting; keep the one with the least error on the rows held back."""
        began = time.process_time()
        q, v, a, force = self.samples
        z = self.jet(q)
        x = torch.cat([z.value, v], 1).numpy()
        rate = torch.cat([(z.first @ v[..., None])[..., 0], a], 1).numpy()
        u = force[:, self.inputs].numpy()
        held = np.arange(len(x)) % HELD == 0
        settings = list(product(self.degrees, self.thresholds))
        best = np.inf
        for degree, threshold in settings[: max(1, round(share * len(settings)))]:
            powers, coefficients = _sindy(x[~held], u[~held], rate[~held], degree, threshold)
            self.powers, self.coefficients = powers, coefficients[-self.n :]
            error = float(torch.mean((self.acceleration(q[held], v[held], force[held]) - a[held]) ** 2))
            if error < best:
                best, kept = error, (self.powers, self.coefficients)
        self.powers, self.coefficients = kept
        return time.process_time() - began


def _sindy(
    x: np.ndarray, u: np.ndarray, rate: np.ndarray, degree: int, threshold: float
) -> tuple[Tensor, Tensor]:
    """Exponents (terms, inputs) and coefficients (states, terms) of one fit."""
    import pysindy

    model = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=threshold, alpha=1e-9),
        feature_library=pysindy.PolynomialLibrary(degree=degree),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about columns that depend on one another: sin² + cos² = 1
        model.fit(x, t=1.0, x_dot=rate, u=u)
    return torch.tensor(model.feature_library.powers_), torch.tensor(model.coefficients())
