"""The wire protocol: messages, frames, and what is generated from them: the C header."""
