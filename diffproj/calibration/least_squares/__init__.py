"""Minimising: a batched solver that knows no cameras, its losses, and its normal equations."""
