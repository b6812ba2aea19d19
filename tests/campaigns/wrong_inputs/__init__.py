"""Inputs that are wrong and look right: does the depth stay right, or does the verdict say that it is not?"""
