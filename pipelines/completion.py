"""`faintfield --install-completion`, apart from the launcher because it takes long to load, for help that shows it."""

from cyclopts.completion.install import create_install_completion_command

from faintfield.pipelines.launcher import app

install_completion = create_install_completion_command(app.install_completion, add_to_startup=True)
