"""Commands of whole experiments: the emulated chip, studies, benches, the report."""
