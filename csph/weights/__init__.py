"""Find and describe the trained models that come with the package; read published checkpoints."""
