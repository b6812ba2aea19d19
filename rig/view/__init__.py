"""The page of `rig view`: shows a running scan, or a finished run, in the browser. It runs in a separate process.

Input: the slot (`rig.live.slot`) of a running scan, or the folder of a run. Output: one guarded port with our page, the
point cloud as the package viser draws it, and a web socket on which the page gets pictures and figures and asks for
what is under the cursor.
"""
