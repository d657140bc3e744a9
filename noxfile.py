"""The whole test suite under each Python that is installed: `pip install nox; nox`."""

import nox

nox.options.error_on_missing_interpreters = False


@nox.session(python=["3.11", "3.12", "3.13"])
def tests(session: nox.Session) -> None:
    """Install as the README says, and run every test."""
    session.install(".[test]")
    session.run("pytest", *session.posargs)


@nox.session(python="3.11")
def release(session: nox.Session) -> None:
    """Build wheel and sdist, install each into a bare environment of its own, and run the demo with it."""
    session.install("build")
    folder = session.create_tmp()
    session.run("python", "-m", "build", "--outdir", folder)
    session.run("python", "scripts/check_release.py", folder)
