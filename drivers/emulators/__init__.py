"""Emulated devices that speak the real ones' protocols, with the simulated cell behind them."""
