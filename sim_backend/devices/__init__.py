"""The simulated devices. They have the interfaces of the real ones and share one `sim_backend.bench.Bench`."""
