"""The wire protocol: messages, frames, and what is generated from them: the C header and the document's tables."""
