"""Shell completion: a script for bash or zsh that knows the commands and their options, and files elsewhere."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

SHELLS = ("bash", "zsh")
SCRIPT = """_scene2spad() {
    local word="${COMP_WORDS[COMP_CWORD]}" words="%s --help --version --completion"
    if [ "$COMP_CWORD" -gt 1 ]; then
        case "${COMP_WORDS[1]}" in
%s
        *) words="" ;;
        esac
        case "$word" in -*) ;; *) words="" ;; esac
    fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}
complete -o default -F _scene2spad scene2spad
"""


def completion_script(shell: str, options: Mapping[str, Sequence[str]]) -> str:
    """Return the script that a shell evaluates; `options` are those of every command, with their dashes."""
    cases = "\n".join(f'        {name}) words="{" ".join(words)}" ;;' for name, words in options.items())
    start = "autoload -U +X bashcompinit && bashcompinit\n" if shell == "zsh" else ""
    return start + SCRIPT % (" ".join(options), cases)
