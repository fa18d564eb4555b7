"""Link to a Unitree Go2 over DDS: its messages and services, the supervisor process, and the watchdog process."""
