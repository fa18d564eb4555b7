"""Adoption of third-party policies: conversion to surefoot's policy files, and the search for mistakes in it."""
