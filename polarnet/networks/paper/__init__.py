"""The paper's network: a recurrent U-Net with Swin blocks (section 3.3)."""
