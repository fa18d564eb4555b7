/* Drivers of motors, IMU and battery. They implement the functions of hal.h that are not in stm32f4/hal.c. */
#ifndef DRIVERS_H
#define DRIVERS_H

/* hal_read_motors, hal_drive_motors, hal_enable_motors, hal_read_temperatures, hal_hazard, and: */
void start_motors(void);

/* hal_read_imu, hal_read_voltage, hal_sit, and: */
void start_sensors(void);

#endif
