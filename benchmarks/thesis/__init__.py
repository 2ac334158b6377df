"""The reproduction of Plage 2016: experiments, claims, figures."""
