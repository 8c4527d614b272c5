"""The model in PyTorch: arrays and gradients cross by DLPack, and an optimiser of PyTorch finds a hammer."""

from __future__ import annotations

import jax
import jax.numpy as jnp

import pianofit

try:
    import torch  # pyright: ignore[reportMissingImports]
except ImportError:
    raise SystemExit("this example needs PyTorch: pip install torch") from None

IT = pianofit.typical("C4")
GRID = pianofit.contact_grid(IT.string, IT.hammer._replace(v_H0=1.0), IT.geometry)  # enough steps for a slow stroke
PARTIALS, STEPS = 16, 150


def levels(log_hammers):
    """Levels of the first partials, dB [hammers, 16], from logs of K_H, mu, p, M_H and v_H0 [hammers, 5]."""

    def one(log_hammer):
        modes = pianofit.mode_table(
            IT.string, IT.geometry, rate=GRID.rate, n_modes=GRID.n_modes, quantity="bridge-force"
        )
        pulse = pianofit.strike(modes, pianofit.Hammer(*jnp.exp(log_hammer)), steps=GRID.steps)
        return pianofit.levels(modes, pulse.drive)[:PARTIALS]

    return jax.vmap(one)(log_hammers)


def as_torch(function):
    """Return a function of JAX, of one float64 array, as a function of tensors with gradients."""
    forward = jax.jit(lambda x: jax.vjp(function, x))  # the value, and a function that is an array tree itself
    backward = jax.jit(lambda vjp, cotangent: vjp(cotangent))

    class Function(torch.autograd.Function):
        @staticmethod
        def forward(ctx, x):
            with jax.enable_x64(True):
                value, ctx.vjp = forward(jnp.from_dlpack(x.detach().contiguous()))
            return torch.from_dlpack(value)

        @staticmethod
        def backward(ctx, cotangent):
            with jax.enable_x64(True):
                (gradient,) = backward(ctx.vjp, jnp.from_dlpack(cotangent.detach().contiguous()))
            return torch.from_dlpack(gradient)

    return Function.apply


def main() -> None:
    """Check the gradients, and fit four hammers to one sound by Adam."""
    model = as_torch(levels)
    true = torch.log(torch.tensor([[*IT.hammer]], dtype=torch.float64))
    print("gradients agree with differences:", torch.autograd.gradcheck(model, true.clone().requires_grad_(), eps=1e-5))
    torch.manual_seed(0)
    hammers = (true + 0.1 * torch.randn(4, 5, dtype=torch.float64)).requires_grad_()
    optimiser = torch.optim.Adam([hammers], lr=0.02)
    target = model(true)
    for step in range(STEPS + 1):
        optimiser.zero_grad()
        loss = ((model(hammers) - target) ** 2).mean()
        loss.backward()
        optimiser.step()
        if step % 50 == 0:
            print(f"step {step:3}: {loss.item():8.4f} dB²")


if __name__ == "__main__":
    main()
