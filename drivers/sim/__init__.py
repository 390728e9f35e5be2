"""One simulated world and the thin devices that ask it; it shares no code with what it tests."""
