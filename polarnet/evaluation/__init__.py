"""Every method behind one signature, and how it is scored."""
