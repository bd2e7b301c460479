"""polarnet's network: Stokes parameters from the panorama and moments of the events of four channels."""
