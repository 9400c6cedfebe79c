"""What people run: the protocol, the algorithms, the pictures, the configuration and the ``ls3`` command."""
