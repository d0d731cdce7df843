"""Which effects the logs call for, which others would do as well, and how sure the numbers are."""
