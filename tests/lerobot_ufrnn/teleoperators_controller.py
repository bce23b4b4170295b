"""The smallest controller that the real client of `ur_rtde` connects to; in a process of its own."""

import socket
import struct
import threading
import time

ADDRESS = "127.0.0.9"
RTDE_PORT = 30004
RUNNING, SILENT, CLOSED, ONE_PACKAGE = range(4)
"""What the controller does: goes on, sends nothing more, closes its connections, fell silent after one package."""


def receive_message(connection):
    header = connection.recv(3, socket.MSG_WAITALL)
    if len(header) < 3:
        raise ConnectionError
    size, kind = struct.unpack(">HB", header)
    return kind, connection.recv(size - 3, socket.MSG_WAITALL) if size > 3 else b""


def send_message(connection, kind, payload):
    connection.sendall(struct.pack(">HB", 3 + len(payload), kind) + payload)


def serve_rtde(connection, joints, mode):
    """One client of RTDE version 2, told of `timestamp` and `actual_q` at 125 Hz."""
    replies = {
        ord("V"): b"\x01",
        ord("v"): struct.pack(">4I", 5, 11, 0, 0),
        ord("O"): b"\x01DOUBLE,VECTOR6D",
        ord("S"): b"\x01",
        ord("P"): b"\x01",
    }
    try:
        kind = 0
        while kind != ord("S"):
            kind, _ = receive_message(connection)
            send_message(connection, kind, replies[kind])
        stamp = 0.0
        while mode.value != CLOSED:
            if mode.value == RUNNING or (mode.value == ONE_PACKAGE and stamp == 0.0):
                stamp += 0.008
                send_message(connection, ord("U"), b"\x01" + struct.pack(">7d", stamp, *joints))
            time.sleep(0.008)
    except OSError:
        pass
    finally:
        connection.close()


def run_controller(joints, mode, ready):
    """Serves clients until it is killed or `mode` is `CLOSED`."""
    server = socket.create_server((ADDRESS, RTDE_PORT))
    ready.set()
    while mode.value != CLOSED:
        connection, _ = server.accept()
        threading.Thread(target=serve_rtde, args=(connection, joints, mode), daemon=True).start()
