import time

from polarnet.terminal.progress import said_after


def test_a_message_explains_long_work_and_stays_away_from_short_work(capsys):
    with said_after(60.0, "short"):
        pass
    with said_after(0.0, "long"):
        time.sleep(0.5)
    assert capsys.readouterr().err == "long\n"
