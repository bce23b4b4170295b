"""Robots that the policy is deployed on."""
