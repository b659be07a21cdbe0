"""Upload an export to the Hugging Face hub."""

from __future__ import annotations

import logging
from pathlib import Path

from dynapix.conf.errors import UserError

log = logging.getLogger(__name__)


def push_folder(folder: Path, repository: str) -> str:
    """Upload an export to a dataset repository, which is created if it is missing, and return the
    address of the commit. A repeated upload skips the files that are already there.

    Args:
        repository: ORGANISATION/NAME.

    Raises:
        UserError: There is no token, it lacks rights, the name is not valid, or the hub does not
            answer.
    """
    from huggingface_hub import HfApi

    # HTTPError is that of the client's HTTP library, whose name depends on its version.
    from huggingface_hub.errors import HFValidationError, HTTPError

    api = HfApi()
    try:
        # Reading the token's owner tells a missing token from one without rights.
        api.whoami()
        api.create_repo(repository, repo_type="dataset", exist_ok=True)
        commit = api.upload_folder(
            repo_id=repository,
            folder_path=folder,
            repo_type="dataset",
            commit_message=f"Upload {folder.name}",
        )
    # The client reports a failed upload of a file as a RuntimeError with a cause.
    except (HTTPError, HFValidationError, OSError, RuntimeError) as error:
        reason = " ".join(f"{error} {error.__cause__ or ''}".split())
        raise UserError(
            f"{folder} is not uploaded to {repository}: {reason}. The export is complete; give "
            "a token that may write there (hf auth login, or HF_TOKEN), and run this again",
            code="not-uploaded",
        ) from error
    return str(commit.commit_url)
