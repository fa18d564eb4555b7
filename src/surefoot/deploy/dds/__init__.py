"""Link to a robot over DDS: messages and services of a Unitree Go2, the keeper process and its watcher."""
