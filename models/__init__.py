import logging

# bitsandbytes warns at its import that a CPU kernel for inference is missing. Training does not use
# it: the kernel passes no gradient on.
logging.getLogger("bitsandbytes.backends.cpu.ops").setLevel(logging.ERROR)
