"""The twin as one ONNX file with its card."""
