"""Networks as guests: 2-D joints by an ONNX file of the user's own, run by OpenCV. None is shipped or fetched."""
