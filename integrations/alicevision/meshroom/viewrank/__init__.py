"""Nodes of viewrank for Meshroom."""
