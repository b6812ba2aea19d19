"""Models of the devices' firmware: bytes in, bytes out, made from manuals and public sources."""
