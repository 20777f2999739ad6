"""`toolpoint keys`: whose signatures count, and signing what stands on the machine already."""

import shlex
from pathlib import Path

import click

from daemon.cli.command_group import Group
from daemon.cli.common import FAILED, config_option, read_configuration, refuse, say, write_json
from daemon.cli.options import json_option


@click.group(cls=Group)
def keys() -> None:
    """Keys by which people answer for releases, commissioning records and back-ups.

    Where the folder signatures.public_keys holds a key, the daemon refuses releases and commissioning records that
    none of them has signed, and `toolpoint restore` such back-ups. Without a key nothing is checked.
    """


@keys.command()
@click.argument("name")
@config_option
def make(name: str, config_path: Path) -> None:
    """Make the key of this account, and let it count as NAME.

    The private key stays in the home of this account (or where TOOLPOINT_SIGNING_KEY names). The public key goes to
    signatures.public_keys; where this account may not write there, it lies beside the private one until root copies
    it. NAME.release, NAME.commissioning and NAME.back-up count for one purpose alone.
    """
    from config.signing import PUBLIC_SUFFIX, trusted_key
    from config.signing_key import SigningKey, private_key_path

    folder, path = read_configuration(config_path).signatures.public_keys, private_key_path()
    public = folder / f"{name}{PUBLIC_SUFFIX}"
    try:
        if public.exists() or public.parent != folder:
            raise FileExistsError(0, "there is such a key already, or this is no name for one")
        made = not path.exists()
        key = SigningKey.make(path) if made else SigningKey.load(path)
        say(f"private key: {path}{'' if made else ' (was there)'}")
        trusted_key(public, key.public)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with public.open("xb") as file:
                file.write(key.public)
            public.chmod(0o644)
        except PermissionError:
            (copy := path.with_name(public.name)).write_bytes(key.public)
            command = shlex.join(["sudo", "install", "-D", "--mode=0644", str(copy), str(public)])
            refuse(
                f"public key: {copy} ({key.number}); it counts once root has put it into {folder}: {command}", FAILED
            )
    except OSError as error:
        cause = f"the public key cannot be put there ({error.strerror})"
        refuse(f"{public}: {cause}; an account that may write there must do it", FAILED)
    say(f"public key: {public} ({key.number}); keep a copy of both apart")
    say("what is not signed is refused from now on: `toolpoint keys sign`")


@keys.command("list")
@config_option
@json_option
def list_command(config_path: Path, json_path: str | None) -> None:
    """Show which keys are accepted, and who has signed what on this machine."""
    from config.signing import TrustedKeys
    from daemon.model_release.resigning import signables

    configuration = read_configuration(config_path)
    trusted, found = TrustedKeys.read(configuration.signatures.public_keys), signables(configuration)
    write_json(
        json_path,
        {
            "keys": [
                {"name": key.name, "number": number, "purposes": list(key.purposes)}
                for number, key in trusted.keys.items()
            ],
            "files": [
                {"path": str(each.path), "signed_by": each.signed_by or None, "problem": each.problem} for each in found
            ],
        },
    )
    if json_path is not None:
        return
    for number, key in trusted.keys.items():
        click.echo(f"{number}  {key.name}  {', '.join(key.purposes)}")
    if not trusted.keys:
        click.echo(f"no key counts ({trusted.folder}), so no signature is asked for")
    for each in found:
        click.echo(f"{each.in_words}: {each.problem or 'signed by ' + (each.signed_by or 'no accepted key')}")


@keys.command()
@click.option("--yes", is_flag=True, help="Answer for all of it without being asked.")
@config_option
def sign(yes: bool, config_path: Path) -> None:
    """Sign the releases and the commissioning record on this machine that no accepted key has signed.

    You answer for them as if you had made them: check each first. So a machine of before there were signatures, or
    one whose key was lost, is taken over.
    """
    from config.signing_key import SigningKey, private_key_path
    from daemon.model_release import resigning

    configuration = read_configuration(config_path)
    waiting = [each for each in resigning.signables(configuration) if not each.signed_by]
    key = SigningKey.load(private_key_path())
    for each in waiting:
        if not yes and not click.confirm(f"{each.in_words} ({each.path}): do you answer for it?", err=True):
            continue
        try:
            resigning.sign(each, key)
        except OSError as error:
            refuse(f"{each.path}: cannot be signed ({error.strerror}) by this account", FAILED)
        say(f"signed {each.path}")
    if not waiting:
        say("nothing waits for a signature")
