"""Where texture can be trusted."""
