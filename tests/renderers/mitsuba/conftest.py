"""Tests of the renderer run on LLVM."""

from llvm_backend import _llvm

__all__ = ["_llvm"]
