"""Policy files: contract, export to ONNX, and the runtime that runs them."""
