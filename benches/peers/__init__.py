"""Other solvers of the same problem, each written from its published formula.

Each module has one function, ``solve(frames, shifts, error_of, tolerance, seconds)``: it runs until
the true largest relative error of M, by `error_of`, is at most the tolerance or the seconds are
over, and tells how far it came. Time spent on `error_of` or on compiling does not count.

    race                the clock and the stop, for solvers that go pass by pass
    kuhn_lin_loranz     additive fixed point over pairs of exposures (mk_kuhn_flat)
    over_relaxed        the same by successive over-relaxation (HMI)
    alternating         the paper's coordinate descent as numba loops
    log_lsmr            SciPy's LSMR on the logarithms
    table               their rows in the table of `make bench`
"""
