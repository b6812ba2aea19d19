"""Models of the devices' firmware: bytes in, bytes out, written from manuals and public sources."""
