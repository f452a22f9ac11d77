"""The model maker: from measured runs of healthy fans to a digital twin in one ONNX file."""
