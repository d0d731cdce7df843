"""The numbers of a distribution by parameter, which print as a table."""

from bayessim_mjx.quantities import number, spread


class Description(dict[str, dict[str, float]]):
    """{parameter: {number: value}}, see `Distribution.describe`; as text a line for each parameter."""

    def __str__(self) -> str:
        wide = max(map(len, self), default=0)
        found = {name: spread(*(row[key] for key in ("median", "q16", "q84", "sd"))) for name, row in self.items()}
        long = max(map(len, found.values()), default=0)
        return "\n".join(
            f"{name:{wide}}  {found[name]:>{long}}  in {number(row['low'])} to {number(row['high'])}"
            for name, row in self.items()
        )
