"""Render scene sets, in processes or on a cluster; test sets, planes, captures."""
