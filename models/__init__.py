import logging

# bitsandbytes warns when it is imported that a CPU kernel for inference is missing. This kernel is
# not needed: it passes no gradient on, so training could not use it.
logging.getLogger("bitsandbytes.backends.cpu.ops").setLevel(logging.ERROR)
