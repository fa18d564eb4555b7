"""Wire protocol on a serial line: encoding of messages, frames, and the generated C header."""
