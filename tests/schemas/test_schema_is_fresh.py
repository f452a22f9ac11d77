"""The generated code is what fan.proto says now."""

from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", ["fan_pb2.py", "fan_pb2.pyi"])
def test_the_generated_code_agrees_with_the_schema(tmp_path, name):
    protoc = pytest.importorskip("grpc_tools.protoc", reason="grpcio-tools of the extra `dev` is not installed")
    arguments = ["protoc", f"-I{ROOT}", f"--python_out={tmp_path}", f"--pyi_out={tmp_path}", "schemas/fan.proto"]
    assert protoc.main(arguments) == 0
    fresh = (tmp_path / "schemas" / name).read_text()
    assert fresh == (ROOT / "schemas" / name).read_text(), "stale: run `make schema`"
