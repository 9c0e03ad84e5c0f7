"""Evaluators: observation -> encoding -> dissimilarity to every landmark (II-A).

The only package that decodes images or knows about image features. Start at `base.Evaluator` (the contract)
and `registry.make_evaluator` (the way in).
"""
