"""UF-RNN written a second time, in NumPy float64, with loops and no batching, from the paper and not from our code."""

import numpy as np


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def lstm(weights, prefix, x, h, c):
    """Hochreiter's cell with PyTorch's gate order: input, forget, candidate, output."""
    gates = weights[f"{prefix}.weight_ih"] @ x + weights[f"{prefix}.bias_ih"]
    gates = gates + weights[f"{prefix}.weight_hh"] @ h + weights[f"{prefix}.bias_hh"]
    i, f, g, o = np.split(gates, 4)
    c = sigmoid(f) * c + sigmoid(i) * np.tanh(g)
    return sigmoid(o) * np.tanh(c), c


class Oracle:
    """One sequence of the SH-LSTM; a state is (h_joint, c_joint, h_image, c_image, h_shared, c_shared)."""

    def __init__(self, network):
        self.weights = {key: value.detach().double().numpy() for key, value in network.state_dict().items()}
        self.joint_dim, self.feature_dim = network.joint_dim, network.feature_dim
        self.low, self.high = network.log_variance_range

    def step(self, inputs, state):
        h_joint, c_joint, h_image, c_image, h_shared, c_shared = state
        h_shared, c_shared = lstm(self.weights, "shared_cell", np.concatenate([h_joint, h_image]), h_shared, c_shared)
        down = self.weights["shared_to_lower.weight"] @ h_shared + self.weights["shared_to_lower.bias"]
        h_joint, c_joint = lstm(self.weights, "joint_cell", inputs[: self.joint_dim], down[: len(h_joint)], c_joint)
        h_image, c_image = lstm(self.weights, "image_cell", inputs[self.joint_dim :], down[len(h_joint) :], c_image)
        return [h_joint, c_joint, h_image, c_image, h_shared, c_shared]

    def predict(self, state):
        joint = self.weights["joint_head.weight"] @ state[0] + self.weights["joint_head.bias"]
        image = self.weights["image_head.weight"] @ state[2] + self.weights["image_head.bias"]
        j, f = self.joint_dim, self.feature_dim
        mean = np.tanh(np.concatenate([joint[:j], image[:f]]))
        raw = np.concatenate([joint[j : 2 * j], image[f : 2 * f]])
        raw = self.high - np.log1p(np.exp(self.high - raw))
        log_variance = self.low + np.log1p(np.exp(raw - self.low))
        command = mean[:j]
        if "command_head.weight" in self.weights:
            command = np.tanh(self.weights["command_head.weight"] @ state[0] + self.weights["command_head.bias"])
        return mean, log_variance, np.array([joint[-1], image[-1]]), command

    def uncertainty(self, log_variance, aggregation):
        values = log_variance if aggregation == "entropy" else np.exp(log_variance)
        return values[: self.joint_dim].mean() + values[self.joint_dim :].mean()

    def imagine(self, state, horizon):
        """Predictions after each closed-loop step."""
        futures = []
        for _ in range(horizon):
            state = self.step(self.predict(state)[0], state)
            futures.append(self.predict(state))
        return futures
