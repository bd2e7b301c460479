"""From a recording or a live camera to frames of polarization, pictures, video and a page."""
