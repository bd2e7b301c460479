"""The pixel model `esim_gpu`: ESIM's GPU variant, on the kernels of `esim`."""

from polarnet.simulation.pixels import esim

EIGHT_BIT_VIDEO = esim.EIGHT_BIT_VIDEO
initial, start, advance = esim.initial, esim.start, esim.advance


def physics_of(config: esim.EsimConfig) -> esim.Physics:
    """The parameters of the GPU variant."""
    return esim.physics_of(config, gpu=True)
