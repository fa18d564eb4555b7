/* Motors, IMU and battery of a robot: besides these functions, those of hal.h from hal_read_motors to hal_sit. */
#ifndef MOTORS_H
#define MOTORS_H

/* Start drivers and sensors; hal_time runs already. */
void start_motors(void);

#endif
