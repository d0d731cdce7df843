"""The deployment contract: logs of a deployed policy against the manifest that was exported with it."""
