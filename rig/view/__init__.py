"""The page of `rig view`: shows a running scan, or a finished run, in the browser. It runs in a process of its own.

Input: the slot of a running scan, or the folder of a run. Output: one guarded port with our page, viser's point cloud,
and a web socket on which the page gets pictures and figures and asks for what is under the cursor.
"""
