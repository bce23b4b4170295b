"""Measurements of the policy and its parts; none is needed for training or acting."""
