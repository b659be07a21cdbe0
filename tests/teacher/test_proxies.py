"""A proxy of the environment is named wherever it may be the cause of an error."""

from __future__ import annotations

from dataclasses import replace

import pytest

from dynapix.conf.proxies import proxy_hint
from dynapix.conf.schema import ServerConfig
from dynapix.evaluation.generators.openai_server import served_origin
from dynapix.models.checks import check_available
from tests.local import free_port
from tests.teacher.faulty_server import teacher_at
from tests.teacher.test_server import complete
from tests.user_errors import raises_user_error

VARIABLES = ("HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy")
HELP = ("NO_PROXY", "127.0.0.1")


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch) -> None:
    for name in (*VARIABLES, "HTTPS_PROXY", "https_proxy", "NO_PROXY", "no_proxy"):
        monkeypatch.delenv(name, raising=False)


@pytest.mark.parametrize("name", VARIABLES)
@pytest.mark.parametrize("address", ["http://127.0.0.1:{}", "socks5://127.0.0.1:{}", "odd://h:{}"])
def test_a_proxy_that_does_not_work_is_named(start_server, monkeypatch, name, address) -> None:
    server = start_server()
    monkeypatch.setenv(name, address.format(free_port()))
    cfg = teacher_at(server, unreachable_timeout=0.0)
    code = "no-server" if address.startswith("http:") else "proxy"
    with raises_user_error(code, contains=(f"variable {name}:", *HELP)):
        complete(cfg)
    with raises_user_error(code, contains=(f"variable {name}:", *HELP)):
        served_origin(ServerConfig(url=server.url, model="other"))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    assert complete(replace(cfg, unreachable_timeout=5.0))
    assert served_origin(ServerConfig(url=server.url, model="other"))


def test_a_proxy_before_the_hub_is_named(monkeypatch) -> None:
    def refuse(_: str) -> None:
        raise ConnectionError("refused")

    monkeypatch.setattr("dynapix.models.checks.find_commit", refuse)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setenv("ALL_PROXY", "socks5://127.0.0.1:9")
    with raises_user_error("missing-model", contains=("refused; requests", "ALL_PROXY")):
        check_available("student", "acme/tiny")


def test_a_password_of_a_proxy_is_not_printed(monkeypatch) -> None:
    monkeypatch.setenv("HTTPS_PROXY", "http://user:secret@proxy.example.org:3128")
    assert proxy_hint("http://example.org/v1") == ""
    hint = proxy_hint("https://example.org/v1")
    assert "HTTPS_PROXY" in hint
    assert "secret" not in hint
